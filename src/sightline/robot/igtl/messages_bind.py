"""BIND: several messages sent as one."""

import struct
from dataclasses import dataclass
from typing import Self

from sightline.errors import MessageError
from sightline.robot.igtl.header import TYPE_BYTES
from sightline.robot.igtl.kinds import Body, is_plain, read_plain
from sightline.robot.igtl.wire import Reader, field, text_of


@dataclass(frozen=True)
class Bind:
    """`children`: (name, body) each; none may be a BIND, since nesting would let a few bytes demand any depth."""

    type_name = "BIND"
    children: tuple[tuple[str, Body], ...]

    @classmethod
    def read(cls, content: bytes) -> Self:
        """Read types and sizes, names, contents. Raises MessageError if a child has an unknown type."""
        reader = Reader(content)
        (count,) = reader.unpack("H")
        heads = [(reader.text(TYPE_BYTES), *reader.unpack("Q")) for _ in range(count)]
        names = _names(reader.take(reader.unpack("H")[0]), count)
        children = []
        for name, (type_name, size) in zip(names, heads, strict=True):
            if not is_plain(type_name):
                raise MessageError(f"binds a message of type {type_name!r}, which is not read here")
            children.append((name, read_plain(type_name, reader.take(size))))
            reader.take(size % 2)
        reader.finish()
        return cls(tuple(children))

    def content(self) -> bytes:
        """Return types and sizes, names, contents; names and contents are padded to even sizes."""
        heads, contents, names = struct.pack(">H", len(self.children)), b"", []
        for name, body in self.children:
            if not is_plain(body.type_name):
                raise MessageError(f"a message of type {body.type_name} cannot be bound")
            content = body.content()
            heads += field(body.type_name, TYPE_BYTES, "type") + struct.pack(">Q", len(content))
            contents += content + bytes(len(content) % 2)
            names.append(field(name, len(name.encode("utf-8")), "name"))
        table = _name_table(names)
        return heads + struct.pack(">H", len(table)) + table + contents


def _names(table: bytes, count: int) -> list[str]:
    names = table.split(b"\0")[:count]
    if table != _name_table(names):
        raise MessageError(f"has a table of names that is not that of {count} messages")
    return [text_of(name) for name in names]


def _name_table(names: list[bytes]) -> bytes:
    """Return the names, each followed by a zero, padded with a zero to an even size."""
    table = b"".join(name + b"\0" for name in names)
    return table + bytes(len(table) % 2)
