"""Errors that a user can do something about; each message says what was wrong, where, and what to type next."""


class ThegraError(Exception):
    """Base of every error that the command line shows as one message (exit code 2) instead of a traceback."""


class InputError(ThegraError):
    """A recording, topic or image cannot be used."""


class CalibrationError(ThegraError):
    """Intrinsics are missing, zero, or do not belong to the images."""


class ConfigError(ThegraError):
    """A configuration file or a `--set` option is not understood."""


class WeightsError(ThegraError):
    """A network's weights are missing or damaged."""


class MappingError(ThegraError):
    """The process of the mapping stage has ended with an error."""
