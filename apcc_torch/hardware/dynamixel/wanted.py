"""What the registers of a motor have to hold: when it is connected, and when torque goes on."""

from __future__ import annotations

from apcc_torch.hardware.dynamixel.registers import (
    ACCELERATION_UNIT,
    CURRENT_LIMIT,
    DRIVE_MODE,
    FEEDFORWARD_1ST_GAIN,
    FEEDFORWARD_2ND_GAIN,
    GOAL_CURRENT,
    GOAL_PWM,
    GOAL_VELOCITY,
    MAX_POSITION_LIMIT,
    MAX_PWM,
    MIN_POSITION_LIMIT,
    NO_SECONDARY_ID,
    OPERATING_MODE,
    OPERATING_MODES,
    POSITION_D_GAIN,
    POSITION_I_GAIN,
    POSITION_P_GAIN,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    PWM_LIMIT,
    RETURN_DELAY,
    SECONDARY_ID,
    SHUTDOWN,
    STARTUP_CONFIGURATION,
    STATUS_RETURN_LEVEL,
    VELOCITY_LIMIT,
    VELOCITY_UNIT,
)
from apcc_torch.hardware.dynamixel.settings import VELOCITY, DynamixelSettings
from apcc_torch.hardware.dynamixel.status import ANSWERS_EVERYTHING
from apcc_torch.hardware.servos.register import Register
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN

Wanted = list[tuple[Register, int]]


def of_connected(settings: DynamixelSettings, motor: int) -> Wanted:
    """What scales, shifts or limits a motor's motion, and what the driver lives by, in the order of writing."""
    model = settings.models[motor]
    P, I, D = settings.position_gains or model.gains  # noqa: E741 - as they are called
    current = [(CURRENT_LIMIT, model.current_ticks(settings.currents[motor]))] if model.current_unit else []
    return [
        (RETURN_DELAY, 0),
        (DRIVE_MODE, 0),
        (OPERATING_MODE, OPERATING_MODES[settings.mode_of(motor)]),
        (SECONDARY_ID, NO_SECONDARY_ID),
        (PWM_LIMIT, MAX_PWM),
        *current,
        (VELOCITY_LIMIT, model.velocity_limit),
        (MAX_POSITION_LIMIT, TICKS_PER_TURN - 1),
        (MIN_POSITION_LIMIT, 0),
        (STARTUP_CONFIGURATION, 0),
        (SHUTDOWN, model.shutdown),
        (STATUS_RETURN_LEVEL, ANSWERS_EVERYTHING),
        (POSITION_P_GAIN, P),
        (POSITION_I_GAIN, I),
        (POSITION_D_GAIN, D),
        (FEEDFORWARD_1ST_GAIN, 0),
        (FEEDFORWARD_2ND_GAIN, 0),
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
        (PROFILE_ACCELERATION, round(settings.profile_acceleration / ACCELERATION_UNIT)),
        (PROFILE_VELOCITY, round(settings.profile_velocity / VELOCITY_UNIT)),
        (GOAL_PWM, pwm),
    ]
    if model.current_unit:
        wanted.append((GOAL_CURRENT, model.current_ticks(settings.currents[motor])))
    if settings.mode_of(motor) == VELOCITY:
        wanted.append((GOAL_VELOCITY, 0))
    return wanted
