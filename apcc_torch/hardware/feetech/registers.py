"""The part of the STS series' memory table that the driver uses: addresses, widths, signs, units.

Two bytes have the low one first, where Feetech's SCS servos have the high one first. Signs are a bit beside the
magnitude. From Feetech's memory table of the series (github.com/ftservo/ftservo-wiki) and its SDK's sms_sts.py.
"""

from __future__ import annotations

from math import pi

from apcc_torch.hardware.servos.register import Register, named_bits
from apcc_torch.hardware.servos.spool import TICK

# Kept without power, where the lock is open as they are written.
FIRMWARE_MAJOR = Register("firmware version", 0, 1)
MODEL_NUMBER = Register("model number", 3, 2)
RESPONSE_LEVEL = Register("response level", 8, 1)
MIN_ANGLE = Register("minimum angle limit", 9, 2)
MAX_ANGLE = Register("maximum angle limit", 11, 2)
PHASE = Register("phase", 18, 1)
UNLOAD = Register("unload condition", 19, 1)
POSITION_P_GAIN = Register("position P gain", 21, 1)
POSITION_D_GAIN = Register("position D gain", 22, 1)
POSITION_I_GAIN = Register("position I gain", 23, 1)
ANGLE_RESOLUTION = Register("angle resolution", 30, 1)
POSITION_OFFSET = Register("position offset", 31, 2)
OPERATING_MODE = Register("operating mode", 33, 1)

# Lost at every restart.
TORQUE_SWITCH = Register("torque switch", 40, 1)
ACCELERATION = Register("acceleration", 41, 1)
GOAL_POSITION = Register("goal position", 42, 2, sign_bit=15)
PWM_SPEED = Register("PWM speed", 44, 2)  # of an operating mode that is not used here
RUNNING_SPEED = Register("running speed", 46, 2, sign_bit=15)
TORQUE_LIMIT = Register("torque limit", 48, 2)
LOCK = Register("lock", 55, 1)
PRESENT_POSITION = Register("present position", 56, 2, sign_bit=15)
PRESENT_SPEED = Register("present speed", 58, 2, sign_bit=15)
PRESENT_LOAD = Register("present load", 60, 2, sign_bit=10)  # share of the voltage: no current, and no torque
STATUS = Register("status", 65, 1)
PRESENT_CURRENT = Register("present current", 69, 2, sign_bit=15)

OFF, ON = 0, 1  # of the torque switch; 128 would make the present position the middle of the range, for good
CLOSED, OPEN = 1, 0  # of the lock
POSITION_MODE = 0
FULL_ANGLE = 1 << 4  # of the phase: positions count turns
FINE_SPEED = 1 << 2  # of the phase: the unit of speeds
PWM_SPEED_AT_START = 1000

FARTHEST = 7 * 4096  # ticks: seven turns either way
SPEED_UNITS = (0.732 * 2 * pi / 60, 0.0146 * 2 * pi / 60)  # rad/s, without and with FINE_SPEED
ACCELERATION_UNIT = 100 * TICK  # rad/s^2
MAX_ACCELERATION = 254
MAX_SPEED = 32_767
TORQUE_UNIT = 1e-3  # of the stall torque
CURRENT_UNIT = 6.5e-3  # A

STATUS_BITS = {0: "input voltage", 1: "encoder", 2: "overheating", 3: "overcurrent", 5: "overload"}
PROTECTIONS = 0b10_1100  # let go on overload (bit 5), overcurrent (3) and overheating (2)


def status_names(status: int) -> str:
    """The names of the bits set in a status, "" if none is."""
    return named_bits(status, STATUS_BITS)
