"""What all writers share."""

import json
from typing import Any


def json_bytes(document: dict[str, Any]) -> bytes:
    """A JSON document of plain types; a number that is not finite is a bug."""
    return json.dumps(document, indent=1, allow_nan=False).encode()
