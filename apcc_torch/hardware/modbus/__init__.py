"""Proportional pressure regulators over Modbus TCP."""
