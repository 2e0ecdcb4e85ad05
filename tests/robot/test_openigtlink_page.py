"""The examples of docs/openigtlink.md run and say what the page says."""

import re
from pathlib import Path

import pytest

from sightline.robot.igtl import MAX_BODY_BYTES
from sightline.robot.igtl.messages import READERS
from sightline.robot.transport import connection as server

PAGE = (Path(__file__).parents[2] / "docs" / "openigtlink.md").read_text()
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(("number", "said"), [(0, "TGT_1 left [0. 0. 0.]\n"), (1, "ACK_1\n")])
def test_examples_run(number: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(EXAMPLES[number], "docs/openigtlink.md", "exec"), {"__name__": "example"})  # noqa: S102 - our page
    assert capsys.readouterr().out == said


def test_limits_and_types_are_those_of_the_code() -> None:
    assert len(EXAMPLES) == 2
    assert f"more than {MAX_BODY_BYTES >> 20} MiB" in PAGE
    assert f"at most {server.MAX_CLIENTS} clients" in PAGE
    assert [name for name in READERS if not re.search(rf"\b{name}\b", PAGE)] == []
