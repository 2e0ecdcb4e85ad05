"""XML from untrusted sources: declarations in the document type are refused, so no entity is expanded or fetched."""

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from sightline.errors import UnusableInputError

_MAX_DEPTH = 16  # [ours] of nested elements; RTK's files have 3


def parse(data: bytes) -> Element:
    """Return the root of an XML text; a bare `<!DOCTYPE NAME>`, as in RTK, is ignored. Raises UnusableInputError."""
    builder, depth = TreeBuilder(), 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _MAX_DEPTH:
            raise UnusableInputError("the XML is nested too deeply to be a geometry")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def document_type(_name: str, system: str | None, public: str | None, internal: bool) -> None:
        if system or public or internal:
            raise UnusableInputError(
                "remove everything but the name from the XML's document type: declarations in it are not accepted"
            )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, document_type
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise UnusableInputError(f"the file is not XML: {error}") from None
    return builder.close()
