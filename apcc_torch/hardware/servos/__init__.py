"""What drivers of serial bus servos share: port, bus, registers, spools, settings, and the tendons on top."""
