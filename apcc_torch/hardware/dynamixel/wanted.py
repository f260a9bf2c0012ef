"""What the registers of a motor have to hold: when it is connected, and when torque goes on."""

from __future__ import annotations

from apcc_torch.hardware.dynamixel import registers
from apcc_torch.hardware.dynamixel.settings import VELOCITY, DynamixelSettings
from apcc_torch.hardware.dynamixel.status import ANSWERS_EVERYTHING
from apcc_torch.hardware.servos.register import Register
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN

Wanted = list[tuple[Register, int]]


def of_connected(settings: DynamixelSettings, motor: int) -> Wanted:
    """What scales, shifts or limits a motor's motion, and what the driver lives by, in the order of writing."""
    model = settings.models[motor]
    P, I, D = settings.position_gains or model.gains  # noqa: E741 - as they are called
    current = [(registers.CURRENT_LIMIT, model.current_ticks(settings.currents[motor]))] if model.current_unit else []
    return [
        (registers.RETURN_DELAY, 0),
        (registers.DRIVE_MODE, 0),
        (registers.OPERATING_MODE, registers.OPERATING_MODES[settings.mode_of(motor)]),
        (registers.SECONDARY_ID, registers.NO_SECONDARY_ID),
        (registers.PWM_LIMIT, registers.MAX_PWM),
        *current,
        (registers.VELOCITY_LIMIT, model.velocity_limit),
        (registers.MAX_POSITION_LIMIT, TICKS_PER_TURN - 1),
        (registers.MIN_POSITION_LIMIT, 0),
        (registers.STARTUP_CONFIGURATION, 0),
        (registers.SHUTDOWN, model.shutdown),
        (registers.STATUS_RETURN_LEVEL, ANSWERS_EVERYTHING),
        (registers.POSITION_P_GAIN, P),
        (registers.POSITION_I_GAIN, I),
        (registers.POSITION_D_GAIN, D),
        (registers.FEEDFORWARD_1ST_GAIN, 0),
        (registers.FEEDFORWARD_2ND_GAIN, 0),
    ]


def of_armed(settings: DynamixelSettings, motor: int, pwm: int) -> Wanted:
    """What a tripped watchdog has dropped, and what else limits the motion and does not outlive a restart.

    Args:
        settings: Of the bus.
        motor: Its id.
        pwm: What it may take of the supply's voltage, in the register's unit.
    """
    model = settings.models[motor]
    wanted = [
        (registers.PROFILE_ACCELERATION, round(settings.profile_acceleration / registers.ACCELERATION_UNIT)),
        (registers.PROFILE_VELOCITY, round(settings.profile_velocity / registers.VELOCITY_UNIT)),
        (registers.GOAL_PWM, pwm),
    ]
    if model.current_unit:
        wanted.append((registers.GOAL_CURRENT, model.current_ticks(settings.currents[motor])))
    if settings.mode_of(motor) == VELOCITY:
        wanted.append((registers.GOAL_VELOCITY, 0))
    return wanted
