from contextlib import AbstractContextManager

from .workflows.progress import Report, Terminal, stage


def shown(what: str) -> AbstractContextManager[Report]:
    return stage(what, Terminal())
