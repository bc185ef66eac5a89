"""Check of host names, before a device is opened."""


def is_host(name: str) -> bool:
    """Whether `name` can be an IP address or a host name.

    False for an empty part ("192.168.1..20"), a part of more than 63 characters, and characters such as NUL, for which
    Python's sockets raise errors that are not OSError.
    """
    try:
        return bool(name.encode("idna")) and name.isprintable()
    except UnicodeError:
        return False
