"""Files as 3D Slicer 5 writes them, made by hand from the formats' own documents."""

import numpy as np


def vtk_model(vertices, polygons, *, binary=True, version="4.2", space="LPS", extra=""):
    """A model as legacy VTK.

    Args:
        vertices: Shape (n, 3).
        polygons: Lists of corners.
        binary: Slicer's default; else ASCII.
        version: Slicer's is 4.2; VTK 9 writes 5.1, whose cells are offsets and connectivity.
        space: In the title, which Slicer writes.
        extra: Text before the points.
    """

    def numbers(values, kind):
        if binary:
            return np.asarray(values).astype(kind).tobytes() + b"\n"
        flat = [f"{value:.17g}" for value in np.ravel(values)]
        rows = (" ".join(flat[at : at + 9]) for at in range(0, len(flat), 9))
        return "".join(f"{row} \n" for row in rows).encode()

    head = (
        f"# vtk DataFile Version {version}\n3D Slicer output. SPACE={space}\n{'BINARY' if binary else 'ASCII'}\n"
        f"DATASET POLYDATA\n{extra}POINTS {len(vertices)} float\n"
    )
    corners = np.concatenate(polygons)
    if version < "5":
        table = np.concatenate([[len(one), *one] for one in polygons])
        cells = f"POLYGONS {len(polygons)} {len(table)}\n".encode() + numbers(table, ">i4")
    else:
        offsets = np.cumsum([0, *map(len, polygons)])
        cells = f"POLYGONS {len(offsets)} {len(corners)}\nOFFSETS vtktypeint64\n".encode() + numbers(offsets, ">i8")
        cells += b"CONNECTIVITY vtktypeint64\n" + numbers(corners, ">i8")
    data = f"\nCELL_DATA {len(polygons)}\nPOINT_DATA {len(vertices)}\nNORMALS Normals float\n".encode()
    return head.encode() + numbers(vertices, ">f4") + b"\n" + cells + data + numbers(vertices, ">f4")
