"""The errors a user can meet. Each message holds the rule, the value found, and the remedy."""

from __future__ import annotations

from pathlib import Path


class ClearError(Exception):
    """Base of every error that the command line shows in one line, without a traceback."""

    exit_code: int = 2
    """The exit code of a process that ends by the error."""


class DataError(ClearError, ValueError):
    """Input that cannot be used: `file: field: what is wrong: what to do`."""

    def __init__(self, file: str | Path, field: str, problem: str, remedy: str) -> None:
        self.file, self.field, self.problem, self.remedy = str(file), field, problem, remedy
        super().__init__(": ".join(one_line(part) for part in (self.file, field, problem, remedy)))


class SettingError(ClearError, ValueError):
    """A setting that cannot be used. The message gives the rule, the value found and, where it helps, the remedy.

    A class that refuses its own field names the field; `clear_strategies.settings.build` puts the key of the
    configuration in front.
    """


class StrategyConflict(ClearError, TypeError):
    """Two strategies answer a question that only one may answer, or one strategy takes part in two runs at once."""


class AnswerError(ClearError, TypeError):
    """A strategy answers a hook with what that hook must not give. The message names both, the rule, and what was found."""


class DivergedError(ClearError, FloatingPointError):
    """A number is NaN or infinite. The message names the tensor, the Gaussian, the view and the iteration."""


class DensityError(ClearError, RuntimeError):
    """Pruning would leave too few Gaussians to go on."""


class AnchorError(ClearError, RuntimeError):
    """The number of Gaussians changed after their anchor was taken (Eq. 16)."""


class HostError(ClearError, RuntimeError):
    """Another trainer does something that is not supported. The message says what, and what to change there."""


def counted(n: int, thing: str) -> str:
    """A number of things in words: 1 view, 2 views."""
    return f"{n:,} {thing}{'' if n == 1 else 's'}"


def one_line(text: object) -> str:
    """A text, or the message of an error, in one line."""
    return " ".join(str(text).split())
