"""The exceptions sliplens raises for mistakes a user can correct; each message is one sentence with the cure."""

from collections.abc import Mapping

_LONGEST = 1500


class SliplensError(Exception):
    """Base class of all user errors: one sentence with the cure, which the command line prints (exit code 2)."""

    def __str__(self) -> str:
        text = super().__str__()
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 500]}\N{HORIZONTAL ELLIPSIS}{text[-499:]}"


class InputError(SliplensError):
    """A file, folder or option that is missing or cannot be used."""


class ImageError(InputError):
    """An image that cannot be read, or has another size, channel count or bit depth than is needed."""


class RecordingError(InputError):
    """A recording or data set that breaks a law: empty, times not rising, a label outside [0, 1]."""


class SourceError(InputError):
    """A running source that is lost, taken, or gives what is no frame; it may come back."""


class CheckpointError(InputError):
    """A checkpoint that is incomplete, damaged, or does not fit the data it is asked about."""


class PartError(SliplensError):
    """Some parts of a work failed while all others were made; the command line exits with code 1."""

    def __init__(self, errors: Mapping[str, str], *, parts: int) -> None:
        self.errors = dict(errors)
        """Message of each part by its name."""
        failed = f"{len(self.errors)} of {parts} could not be done, all others are"
        self.summary = f"{failed}; correct the errors and give the same command again:"
        """First line of the message: how many parts failed, and how to retry."""
        lines = [f"{name}: {sentence}" for name, sentence in self.errors.items()]
        super().__init__("\n  ".join([self.summary, *lines]))


class ContactError(SliplensError):
    """A physical parameter or load that cannot occur."""


class ModelError(SliplensError):
    """A network that cannot be built, trained or explained as asked."""


class SaliencyError(SliplensError):
    """A saliency map that does not fit its image or is not finite."""
