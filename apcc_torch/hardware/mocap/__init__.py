"""Motion capture, whatever its make: clocks, gates, the base frame, and the sensor that a driver derives from."""
