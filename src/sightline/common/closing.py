"""The ends of things: of objects that a `with` block closes, and of a process whose parent has gone."""

import os
import threading
from abc import ABC, abstractmethod
from multiprocessing import parent_process
from multiprocessing.connection import wait
from typing import Self


class Closing(ABC):
    """An object with `close`, called at the end of a `with` block."""

    @abstractmethod
    def close(self) -> None:
        """Release what the object holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def end_with_parent() -> None:
    """End this process when its parent is killed."""

    def wait_for(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    if (parent := parent_process()) is not None:
        threading.Thread(target=wait_for, args=[parent.sentinel], name="parent", daemon=True).start()
