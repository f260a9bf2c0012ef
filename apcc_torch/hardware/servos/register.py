"""One entry of a servo's control table: where it lies, how wide it is, and how it has its sign."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from apcc_torch.errors import CommunicationError, ValueRangeError


class Register(NamedTuple):
    """Address and width in bytes, little-endian, and the sign: none, two's complement, or a bit beside the magnitude.

    Example:
        >>> Register("present speed", 58, 2, sign_bit=15).decode(bytes((5, 0x80)))
        -5
    """

    name: str
    address: int
    length: int
    signed: bool = False
    sign_bit: int | None = None

    def encode(self, value: int) -> bytes:
        """The bytes of `value`.

        Raises:
            ValueRangeError: It does not fit.
        """
        try:
            if self.sign_bit is None:
                return int(value).to_bytes(self.length, "little", signed=self.signed)
            if abs(value) >> self.sign_bit:
                raise OverflowError
            return (abs(int(value)) | (value < 0) << self.sign_bit).to_bytes(self.length, "little")
        except OverflowError as error:
            raise ValueRangeError(f"{self.name} does not fit {self.length} bytes, got {value}") from error

    def decode(self, data: bytes) -> int:
        """The value of bytes that a motor sent.

        Raises:
            CommunicationError: There are more or fewer bytes than the register has.
        """
        if len(data) != self.length:
            raise CommunicationError(f"{self.name} has {self.length} bytes, got {len(data)}")
        value = int.from_bytes(data, "little", signed=self.signed)
        if self.sign_bit is None:
            return value
        magnitude = value & (1 << self.sign_bit) - 1
        return -magnitude if value >> self.sign_bit & 1 else magnitude


def named_bits(value: int, names: Mapping[int, str]) -> str:
    """The names of the bits set in a value, "" if none is."""
    return ", ".join(names.get(bit, f"bit {bit}") for bit in range(8) if value >> bit & 1)
