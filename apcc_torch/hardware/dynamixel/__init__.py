"""Tendons on Dynamixel X motors: registers, port, bus, spools, and the actuator that joins them."""
