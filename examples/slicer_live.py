"""Show live image, plan, CT and tool in 3D Slicer: `Slicer --python-script slicer_live.py` (docs/live.md)."""

import qt
import slicer
import vtk

PORT, CT = 18944, "CT"  # of --serve; name of the node of the CT that was registered

scene = slicer.mrmlScene
link = scene.AddNewNodeByClass("vtkMRMLIGTLConnectorNode", "Sightline")
wire = scene.AddNewNodeByClass("vtkMRMLMarkupsLineNode", "planned wire")  # 100 mm of it, its tip at the origin
lps = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "ras-to-lps")
PLACED = [f"{name}{to}" for name in ("live", "pa", "lateral", "oblique") for to in ("", "-to-cfcs")]
PARENTS = dict.fromkeys([*PLACED, "wire-to-cfcs", "tool-to-cfcs", "ct-to-cfcs"], "cfcs-to-ras")
PARENTS |= {"planned wire": "wire-to-cfcs", CT: "ras-to-lps", "ras-to-lps": "ct-to-cfcs"}


def arrange() -> None:
    """Put what has come under the transform that places it, and show the wire only while its plan is GO."""
    for name, parent in PARENTS.items():
        child, above = scene.GetFirstNodeByName(name), scene.GetFirstNodeByName(parent)
        if child and above:
            child.SetAndObserveTransformNodeID(above.GetID())
    verdict = scene.GetFirstNodeByName("verdict")
    wire.SetDisplayVisibility(bool(link.GetState() == link.StateConnected and verdict and verdict.GetText() == "GO"))


matrix = vtk.vtkMatrix4x4()
matrix.SetElement(0, 0, -1.0)
matrix.SetElement(1, 1, -1.0)
lps.SetMatrixTransformToParent(matrix)
wire.AddControlPoint(vtk.vtkVector3d(0.0, 0.0, -100.0))
wire.AddControlPoint(vtk.vtkVector3d(0.0, 0.0, 0.0))
link.SetTypeClient("localhost", PORT)
link.Start()
timer = qt.QTimer()
timer.connect("timeout()", arrange)
timer.start(500)
