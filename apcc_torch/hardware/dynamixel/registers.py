"""The part of the X series' control table that the driver uses: addresses, widths, signs, and the units all share.

Values are little-endian, protocol 2.0. What differs from model to model is in models.yaml.
"""

from __future__ import annotations

from math import pi

from apcc_torch.hardware.servos.register import Register, named_bits

# Kept without power; written only while torque is off.
MODEL_NUMBER = Register("model number", 0, 2)
FIRMWARE_VERSION = Register("firmware version", 6, 1)
RETURN_DELAY = Register("return delay time", 9, 1)
DRIVE_MODE = Register("drive mode", 10, 1)
OPERATING_MODE = Register("operating mode", 11, 1)
SECONDARY_ID = Register("secondary id", 12, 1)
HOMING_OFFSET = Register("homing offset", 20, 4, signed=True)
PWM_LIMIT = Register("PWM limit", 36, 2)
CURRENT_LIMIT = Register("current limit", 38, 2)
VELOCITY_LIMIT = Register("velocity limit", 44, 4)
MAX_POSITION_LIMIT = Register("max position limit", 48, 4)
MIN_POSITION_LIMIT = Register("min position limit", 52, 4)
STARTUP_CONFIGURATION = Register("startup configuration", 60, 1)
SHUTDOWN = Register("shutdown", 63, 1)

# Lost at every restart.
TORQUE_ENABLE = Register("torque enable", 64, 1)
STATUS_RETURN_LEVEL = Register("status return level", 68, 1)
HARDWARE_ERROR = Register("hardware error status", 70, 1)
POSITION_D_GAIN = Register("position D gain", 80, 2)
POSITION_I_GAIN = Register("position I gain", 82, 2)
POSITION_P_GAIN = Register("position P gain", 84, 2)
FEEDFORWARD_2ND_GAIN = Register("feedforward 2nd gain", 88, 2)
FEEDFORWARD_1ST_GAIN = Register("feedforward 1st gain", 90, 2)
BUS_WATCHDOG = Register("bus watchdog", 98, 1, signed=True)
GOAL_PWM = Register("goal PWM", 100, 2, signed=True)
GOAL_CURRENT = Register("goal current", 102, 2, signed=True)
GOAL_VELOCITY = Register("goal velocity", 104, 4, signed=True)
PROFILE_ACCELERATION = Register("profile acceleration", 108, 4)
PROFILE_VELOCITY = Register("profile velocity", 112, 4)
GOAL_POSITION = Register("goal position", 116, 4, signed=True)
PRESENT_CURRENT = Register("present current", 126, 2, signed=True)
PRESENT_VELOCITY = Register("present velocity", 128, 4, signed=True)
PRESENT_POSITION = Register("present position", 132, 4, signed=True)
PRESENT_INPUT_VOLTAGE = Register("present input voltage", 144, 2)

# Slot k (from 0) shows the byte at the address in 168 + 2k as the byte k of the indirect data, which begin where the
# slots of the model end.
INDIRECT_ADDRESS = 168

OPERATING_MODES = {"velocity": 1, "extended_position": 4, "current_based_position": 5}
MAX_POSITION = 1_048_575  # ticks either way in both position modes
WATCHDOG_UNIT = 0.02  # s
WATCHDOG_TRIPPED = -1
MAX_PWM = 885  # all of the supply's voltage
NO_SECONDARY_ID = 255
MAX_GAIN = 16_383
VELOCITY_UNIT = 0.229 * 2 * pi / 60  # rad/s
ACCELERATION_UNIT = 214.577 * 2 * pi / 3600  # rad/s^2
MAX_PROFILE_TICKS = 32_767
VOLTAGE_UNIT = 0.1  # V

HARDWARE_ERROR_BITS = {0: "input voltage", 2: "overheating", 3: "motor encoder", 4: "electrical shock", 5: "overload"}


def hardware_errors(status: int) -> str:
    """The names of the bits set in a hardware error status, "" if none is."""
    return named_bits(status, HARDWARE_ERROR_BITS)
