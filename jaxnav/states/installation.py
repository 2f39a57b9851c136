"""Errors of mounting and clocks of the sensors, in addition to the values of `Mounting`."""

from jaxnav.maths import units
from jaxnav.states.state import BODY, UserUnit, constant

LEVER_ARM_ERROR = constant("lever_arm_error", BODY, 0.3, UserUnit("m", 1.0, "m"))
"""m, body, of IMU -> antenna: on top of `Mounting.lever_arm`."""
CLOCK_OFFSET = constant("clock_offset", ("late",), 0.05, UserUnit("s", 1.0, "s"))
"""s: the receiver's fixes are older than stated by that, on top of `Mounting.time_offset`."""
ODOMETER_SCALE = constant("odometer_scale", ("scale",), 20_000.0, UserUnit("ppm", units.PPM, "ppm"))
"""1: wheels read too much by that share, on top of the parameter ``scale`` of `SPEED`."""
VEHICLE_AXES = constant("vehicle_axes", ("pitch", "yaw"), 2.0, UserUnit("deg", units.DEG, "deg"))
"""rad, of the vehicle's axes in the body's: on top of `Mounting.vehicle`."""
WHEEL_ARM_ERROR = constant("wheel_arm_error", BODY, 1.0, UserUnit("m", 1.0, "m"))
"""m, body, of IMU -> point where wheels neither slide nor lift: on top of `Mounting.wheel_arm`."""
