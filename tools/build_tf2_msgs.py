"""Compile tf2_msgs/msg/TFMessage, which is in no wheel, into the environment of this Python, beside ROS 2's wheels.

`make ros2` runs it by `.venv/ros2/bin/python`; it needs gcc and g++. A ROS 2 installation has tf2_msgs. Left out is
introspection, which nothing here uses: rcutils says once on stderr that an error state was overwritten.
"""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

IDL = """#include "geometry_msgs/msg/TransformStamped.idl"
module tf2_msgs {
  module msg {
    struct TFMessage {
      sequence<geometry_msgs::msg::TransformStamped> transforms;
    };
  };
};
"""
PREFIX, PACKAGE = Path(sys.prefix), Path(sysconfig.get_path("purelib")) / "tf2_msgs"
FASTRTPS = "rosidl_typesupport_fastrtps_c"
LIBRARIES = [f"geometry_msgs__{part}" for part in ("rosidl_generator_c", FASTRTPS, "rosidl_generator_py")]
LIBRARIES += [
    "rosidl_runtime_c",
    "rosidl_typesupport_c",
    FASTRTPS,
    "rosidl_typesupport_fastrtps_cpp",
    "fastcdr",
    "rcutils",
]


def generate(idl: Path, into: Path) -> None:
    """Write the sources of the message in C and Python."""
    os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport

    for generator in (
        GenerateC("c"),
        GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
        GenerateCTypesupport("c", typesupport_implementations=[FASTRTPS]),  # called without a table of others
        GenerateFastRTPSCTypesupport("fastrtps_c"),
    ):
        generator.generate("tf2_msgs", [f"{idl}:msg/TFMessage.idl"], [str(PREFIX / "share")], into)


def compiled(sources: Path, folder: Path) -> None:
    """Compile and link the one extension that rclpy loads."""
    headers = [sources.parent, PREFIX / "include", *(PREFIX / "include").iterdir()]
    headers += [Path(sysconfig.get_path("include")), Path(np.get_include())]
    objects: list[Path] = []
    for source in (*sources.rglob("*.c"), *sources.rglob("*.cpp")):
        objects.append(folder / f"{source.name}.o")
        compiler = ["gcc"] if source.suffix == ".c" else ["g++", "-std=c++17"]
        run([*compiler, "-c", "-O1", "-fPIC", "-w", *(f"-I{each}" for each in headers), source, "-o", objects[-1]])
    library = PREFIX / "lib"
    linked = [f"-L{library}", f"-Wl,-rpath,{library.resolve()}", *(f"-l{name}" for name in LIBRARIES)]
    run(["g++", "-shared", *objects, *linked, "-o", sources / "tf2_msgs_s__rosidl_typesupport_c.so"])


def run(command: list[object]) -> None:
    """Run a compiler. Raises CalledProcessError."""
    subprocess.run(list(map(str, command)), check=True)  # noqa: S603 - our own arguments


def main() -> None:
    """Build in a folder of its own, and put the package into place."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        idl, sources = folder / "idl" / "msg" / "TFMessage.idl", folder / "tf2_msgs"
        idl.parent.mkdir(parents=True)
        idl.write_text(IDL)
        sources.mkdir()
        generate(idl.parents[1], sources)
        compiled(sources, folder)
        for file in (*sources.glob("*.so"), *sources.glob("msg/*.py")):
            target = PACKAGE / file.relative_to(sources)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
        (PACKAGE / "__init__.py").touch()


if __name__ == "__main__":
    main()
