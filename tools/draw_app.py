"""Write the pictures of the app in the pages, docs/pictures/app-NAME.jpg, from the screenshots that its tests keep.

`pytest -m "slow or not slow" tests/app/test_page.py tests/app/test_nail_walk.py tests/app/test_bone_walk.py`, then
`python tools/draw_app.py`.
"""

from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
NAMES = {
    "plan": "planned",
    "verify": "verified",
    "nail": "nail-walk-planned",
    "bone": "bone-found",
}  # of the pages' pictures and of screenshots
QUALITY = 88  # text stays sharp below 200 kB [ours]


def main() -> None:
    """Write each picture, and say how large it is."""
    for name, shot in NAMES.items():
        path = ROOT / "docs" / "pictures" / f"app-{name}.jpg"
        Image.open(ROOT / "out" / "app" / f"{shot}.png").convert("RGB").save(path, quality=QUALITY, optimize=True)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
