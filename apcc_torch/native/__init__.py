"""Functions of tensors as machine code: traced once, written out as scalar arithmetic, built into a shared library."""
