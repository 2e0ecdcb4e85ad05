"""Parts common to all writers."""

import json
from typing import Any


def json_bytes(document: dict[str, Any]) -> bytes:
    """Return a document of plain types as JSON. Raises ValueError for a number that is not finite, which is a bug."""
    return json.dumps(document, indent=1, allow_nan=False).encode()
