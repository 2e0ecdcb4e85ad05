"""Silence what a library says to the calling thread, or make it an error; a host program's own settings stay.

`warnings.catch_warnings` and `Logger.disabled` act on all threads, and two threads that use them at the same time can
leave them changed. Here a filter is added that knows its threads, and taken away after the last of them.
"""

import warnings
from collections.abc import Generator
from contextlib import contextmanager
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
        self._changed: list[Any] = []  # loggers, and lists of warning filters: a host may replace its own meanwhile

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
        return of_package if self._all else self._is_mine and (of_package or not self._raises)

    def _add(self) -> None:
        filters: Any = warnings.filters
        if self._entry not in filters:
            filters.insert(0, self._entry)
            self._changed.append(filters)
        known = (name for name in list(root.manager.loggerDict) if name.partition(".")[0] in self._packages)
        for log in map(getLogger, {*self._packages, *known}):
            if self not in log.filters:
                log.addFilter(self)
                self._changed.append(log)

    def _remove(self) -> None:
        places: list[Any] = [*self._changed, warnings.filters]
        for place in places:
            if isinstance(place, Logger):
                place.removeFilter(self)
            elif self._entry in place:
                place.remove(self._entry)
        self._changed.clear()
