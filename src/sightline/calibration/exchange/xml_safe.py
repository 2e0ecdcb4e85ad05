"""XML from strangers: no document type with a content, hence no entities: nothing expands and nothing is fetched."""

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from sightline.errors import UnusableInputError

_MAX_DEPTH = 16  # [ours] RTK's files have 3


def parse(data: bytes) -> Element:
    """The root of an XML text. A bare `<!DOCTYPE NAME>`, as RTK writes, is passed over. Raises UnusableInputError."""
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
                "the XML declares a document type of its own; remove everything of it but its name"
            )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, document_type
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise UnusableInputError(f"the file is not XML: {error}") from None
    return builder.close()
