"""Qualisys motion capture, over the real-time protocol of QTM."""
