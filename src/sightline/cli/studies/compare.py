"""`sightline compare`: real images and the twin's, measured in the same way."""

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.options import Invert, command, commands
from sightline.cli.output import Output, as_json


@command(commands, "compare", "sightline compare images --out out/compare")
def compare(
    output: Output,
    *,
    folder: Annotated[Path, typer.Argument(help="Folder of images of one C-arm: plates, beads, open beam, anatomy.")],
    seed: Annotated[int, typer.Option(min=0, help="The twin of image k draws from the generator of [seed, k].")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the page and the plots.")] = Path("out/compare"),
    invert: Invert = False,
) -> None:
    """Compare real images with the digital twin's.

    Both are measured in the same way; the page says by how much they differ.
    """
    import numpy as np

    from sightline.common.atomic import write_folder
    from sightline.studies.comparison.compare import compare as one_pair
    from sightline.studies.comparison.compare import document, findings, plots, read_folder
    from sightline.studies.comparison.page import render

    images, passed = read_folder(folder, invert=invert)
    for reason in passed:
        output.note(f"skipped: {reason}")
    pairs = []
    with output.progress("images and their twins", len(images)) as advance:
        for k, (name, image) in enumerate(images):
            pairs.append(one_pair(name, image, np.random.default_rng([seed, k])))
            advance()
    figures = document(pairs, passed, seed)
    page = render(pairs, passed, folder.name, seed)
    curves = {f"{picture.title.lower().replace(' ', '-')}.svg": picture.svg.encode() for picture in plots(pairs)}
    files = write_folder(out, {"compare.html": page.encode(), "compare.json": as_json(figures).encode(), **curves})
    for finding in findings(pairs):
        output.say(f"- {finding}")
    output.say(f"page: {files[0]}; all values: {files[1]}")
    output.result({**figures, "files": files})
