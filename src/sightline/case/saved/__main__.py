"""Write the published schemas: `python -m sightline.case.saved docs/schemas`."""

import sys
from pathlib import Path

from sightline.case.saved.models import PUBLISHED, schema_text

for name in PUBLISHED:
    (Path(sys.argv[1]) / f"{name}.schema.json").write_text(schema_text(name))
