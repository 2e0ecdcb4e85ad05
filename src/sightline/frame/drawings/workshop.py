"""The files that a workshop needs to make a frame, in one folder."""

from pathlib import Path

from sightline.common.atomic import whole_folder, write_files
from sightline.frame.drawings.bill import bill_csv, bill_page, holes_csv, inspection_csv
from sightline.frame.drawings.mesh import meshes_of
from sightline.frame.drawings.part import parts_of
from sightline.frame.drawings.picture import frame_png
from sightline.frame.drawings.sheet import plate_dxf, plate_svg
from sightline.frame.model import Frame


def write_workshop(frame: Frame, folder: str | Path, clearance_mm: float = 0.0) -> tuple[Path, ...]:
    """Write drawings (SVG, DXF), bores (CSV) and meshes (STL) of every part, bill, inspection sheet and frame file.

    `assembly.png` shows where the balls go. `clearance_mm` is added to the bores' diameters in the STL. Return the
    files written. Raises FrameError for a frame that cannot be made, UnusableInputError where the folder cannot be
    written.
    """
    parts = parts_of(frame)
    files: dict[str, bytes] = {
        "bill.md": bill_page(frame, parts).encode(),
        "bill.csv": bill_csv(parts),
        "inspection.csv": inspection_csv(frame),
        "assembly.png": frame_png(frame),
    }
    for part in parts:
        if part.bores:
            files[f"{part.name}.svg"] = plate_svg(part, frame.name).encode()
            files[f"{part.name}.dxf"] = plate_dxf(part, frame.name)
            files[f"{part.name}.csv"] = holes_csv(part)
    files |= meshes_of(parts, clearance_mm)
    with whole_folder(folder) as scratch:
        write_files(scratch, files)
        frame.save(scratch / "frame.json")
    return tuple(Path(folder) / name for name in sorted([*files, "frame.json"]))
