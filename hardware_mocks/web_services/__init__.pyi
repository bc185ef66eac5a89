from .device import MockWebServices as MockWebServices

__all__ = ["MockWebServices"]
