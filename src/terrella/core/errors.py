"""The errors that Terrella raises on purpose. Each message is one sentence: what is wrong, and what to do."""

_OUT_OF_MEMORY = (  # as PyTorch, Triton and CUDA say it; a library without room for itself is not initialised
    "out of memory", "can't allocate memory", "Cannot allocate memory", "not enough memory", "ALLOC_FAILED",
    "ALLOCATION_FAILED", "CUBLAS_STATUS_NOT_INITIALIZED", "CUDNN_STATUS_NOT_INITIALIZED",
)  # fmt: skip


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a device or the machine had too little memory, by the error of PyTorch, of a library of CUDA, or of Python."""
    named = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    return named or isinstance(error, RuntimeError) and any(words in str(error) for words in _OUT_OF_MEMORY)


def reason_of(error: BaseException) -> str:
    """The first line of an error, for a sentence."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class TerrellaError(Exception):
    """Base of all deliberate errors; the command line prints it as one line and exits with 2."""


class ContractError(TerrellaError):
    """A World or a Policy broke its contract (`check_world` tests that of a World)."""


class ActionError(TerrellaError):
    """An action has the wrong shape, type or range for the world it was given to."""


class ObservationError(TerrellaError):
    """An observation lacks a required channel, or has one of the wrong shape."""


class ChannelError(TerrellaError):
    """A channel was asked for that the world cannot render."""


class PlanningError(TerrellaError):
    """No plan can be made: the goal does not fit the world, no candidate has a cost, or the search does not suit the actions."""


class StaleStateError(TerrellaError):
    """A state was used after its world, which cannot fork, had moved on."""


class DatasetError(TerrellaError):
    """A recording is missing, foreign, truncated or inconsistent."""


class CheckpointError(TerrellaError):
    """A checkpoint is missing, damaged, of another kind, or of a version that this release cannot read."""


class TrainingError(TerrellaError):
    """Training cannot go on: not-a-number losses, a full disk, or a run folder of another recipe."""


class ServeError(TerrellaError):
    """A world cannot be served: the port is in use, the address needs a token, or the world shows no picture."""


class ProtocolError(TerrellaError):
    """A browser sent a message that the server does not understand."""
