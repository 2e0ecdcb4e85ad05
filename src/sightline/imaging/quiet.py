"""Silence what a library says to the calling thread, or make it an error; a host program's own settings stay.

`warnings.catch_warnings` and `Logger.disabled` act on all threads, and two threads that use them at the same time can
leave them changed. Here a filter is added that knows its threads. That of loggers is taken away after the last of them.
That of warnings stays, and matches nothing then: a thread that looks for the filter of its warning would miss the next
one if one were taken out of the list, and CPython 3.11 crashes if the list is replaced meanwhile.
"""

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from itertools import takewhile
from logging import Filter, Logger, LogRecord, getLogger, root
from threading import Lock, local
from typing import Any, Literal


class Quiet(Filter):
    """`with quiet():` drops log records of `packages`, and ignores warnings or raises them as errors (`action`).

    Of the calling thread alone; with `all_threads` of every thread. Errors, and warnings of every thread, are only
    those that `packages` issue.
    """

    def __init__(self, action: Literal["ignore", "error"], *packages: str, all_threads: bool = False) -> None:
        super().__init__()
        self._packages, self._all, self._raises = packages, all_threads, action == "error"
        self._entry: Any = (action, None, Warning, self, 0)  # of `warnings.filters`; `self` is the module's pattern
        self._thread, self._lock, self._users = local(), Lock(), 0
        self._loggers: list[Logger] = []

    @contextmanager
    def __call__(self) -> Generator[None]:
        """Be quiet within the `with` block."""
        before = self._is_mine
        with self._lock:
            self._users += 1
            self._add()
        self._thread.inside = True
        try:
            yield
        finally:
            self._thread.inside = before
            with self._lock:
                self._users -= 1
                if not self._users:
                    self._remove()

    @property
    def _is_mine(self) -> bool:
        return getattr(self._thread, "inside", False)

    def filter(self, record: LogRecord) -> bool:
        """Return whether the record is logged."""
        return not (self._all or self._is_mine)

    def match(self, module: str) -> bool:
        """Return whether a warning that this module issues is ignored, as a pattern of `warnings.filters` does."""
        of_package = module.partition(".")[0] in self._packages
        if self._all:
            return of_package and self._users > 0
        return self._is_mine and (of_package or not self._raises)

    def _add(self) -> None:
        filters: Any = warnings.filters
        first = takewhile(lambda one: isinstance(one[3], Quiet), filters)  # a host may have put others before
        if not any(one is self._entry for one in first):
            filters.insert(0, self._entry)
        known = (name for name in list(root.manager.loggerDict) if name.partition(".")[0] in self._packages)
        for log in map(getLogger, {*self._packages, *known}):
            if self not in log.filters:
                log.addFilter(self)
                self._loggers.append(log)

    def _remove(self) -> None:
        for log in self._loggers:
            log.removeFilter(self)
        self._loggers.clear()
