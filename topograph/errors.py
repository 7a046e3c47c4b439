"""The tree of errors. Each says in one line what is wrong and what to type or check next."""


class TopographError(Exception):
    """Root of all errors that topograph raises on purpose; `exit_code` is the command line's answer."""

    exit_code = 1


class UsageError(TopographError):
    """The words of the command or the keys of a configuration do not fit."""

    exit_code = 2


class InputError(TopographError):
    """A recording cannot be used as it is: missing, truncated, empty, of an unknown layout."""

    exit_code = 3


class TopicError(InputError):
    """No topic, or several, could be the wanted stream."""


class FrameError(InputError):
    """A sensor's frame has no transform to the robot's base."""


class InsufficientDataError(TopographError):
    """The data are readable but do not determine what was asked."""

    exit_code = 4


class MapError(TopographError):
    """A map file is missing, damaged, of a newer schema, or not what was asked for."""

    exit_code = 5
