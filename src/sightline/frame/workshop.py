"""The files that a workshop needs to make a frame, in one folder."""

from pathlib import Path

from sightline.atomic import whole_folder, write_whole
from sightline.frame.bill import bill_csv, bill_page, holes_csv, inspection_csv
from sightline.frame.model import Frame
from sightline.frame.part import parts_of
from sightline.frame.part_dxf import plate_dxf
from sightline.frame.part_mesh import plate_stl
from sightline.frame.part_svg import plate_svg


def write_workshop(frame: Frame, folder: str | Path) -> tuple[Path, ...]:
    """Write drawings (SVG, DXF), bores (CSV) and solids (STL) of every plate, bill, inspection sheet and frame file.

    Return the files written. Raises FrameError for plates that cannot be made, UnusableInputError where the folder
    cannot be written.
    """
    parts = parts_of(frame)
    files: dict[str, bytes] = {
        "bill.md": bill_page(frame, parts).encode(),
        "bill.csv": bill_csv(parts),
        "inspection.csv": inspection_csv(frame),
    }
    for part in parts:
        files[f"{part.name}.svg"] = plate_svg(part, frame.name).encode()
        files[f"{part.name}.dxf"] = plate_dxf(part, frame.name)
        files[f"{part.name}.csv"] = holes_csv(part)
        files[f"{part.name}.stl"] = plate_stl(part)
    with whole_folder(folder) as scratch:
        for name, data in files.items():
            write_whole(scratch / name, data)
        frame.save(scratch / "frame.json")
    return tuple(Path(folder) / name for name in sorted([*files, "frame.json"]))
