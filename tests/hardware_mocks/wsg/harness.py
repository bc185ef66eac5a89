"""Shared helpers of the gripper-mock tests: they share no code with the driver and its codec."""


def checksum(data: bytes) -> int:
    """Bitwise computation of the checksum, with polynomial 0x1021, independent of the table."""
    crc = 0xFFFF
    for byte in data:
        value = ((crc ^ byte) & 0xFF) << 8
        for _ in range(8):
            value = ((value << 1) ^ 0x1021) & 0xFFFF if value & 0x8000 else (value << 1) & 0xFFFF
        crc = value ^ (crc >> 8)
    return crc
