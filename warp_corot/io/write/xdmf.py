"""XDMF: an XML file that refers to each frame's arrays in an HDF5 file beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from warp_corot.io.files.whole import writing, written_whole

from .fields import Fields

HEAD = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n <Domain>\n  <Grid CollectionType="Temporal" GridType="Collection">\n'
)
TAIL = "  </Grid>\n </Domain>\n</Xdmf>\n"
KINDS = {1: "Scalar", 3: "Vector", 9: "Tensor"}


class XdmfWriter:
    """All frames. The XML file is complete after every frame; a mesh is stored once for all frames with it.

    Args:
        path: The .xdmf; its arrays go to the .h5 file of the same name.
    """

    def __init__(self, path: Path):
        self._path = path
        self._numbers: Any = None
        self._grids: list[str] = []
        self._mesh: tuple[np.ndarray, np.ndarray] | None = None
        self._mesh_text = ""

    def write(self, fields: Fields) -> None:
        with writing(self._path):
            self._write(fields)

    def close(self) -> None:
        if self._numbers is not None:
            with writing(self._path):
                self._numbers.close()
        self._numbers = None

    def _write(self, fields: Fields) -> None:
        if self._numbers is None:
            import h5py

            self._numbers = h5py.File(self._path.with_suffix(".h5"), "w")
        frame = f"frame{len(self._grids):05}"
        same = self._mesh is not None and np.array_equal(self._mesh[0], fields.points)
        if self._mesh is None or not (same and np.array_equal(self._mesh[1], fields.tets)):
            self._mesh = fields.points, fields.tets
            nodes = self._stored(f"{frame}/tets", fields.tets)
            points = self._stored(f"{frame}/points", fields.points)
            self._mesh_text = (
                f'<Topology TopologyType="Tetrahedron" NumberOfElements="{len(fields.tets)}">{nodes}</Topology>'
                f'<Geometry GeometryType="XYZ">{points}</Geometry>'
            )
        parts = [f'<Time Value="{fields.time:.9g}"/>', self._mesh_text]
        for centre, arrays in (("Node", fields.nodal), ("Cell", fields.elemental)):
            for name, values in arrays.items():
                kind = KINDS[1 if values.ndim == 1 else values.shape[1]]
                stored = self._stored(f"{frame}/{name}", values)
                named = quoteattr(name)
                parts.append(f'<Attribute Name={named} AttributeType="{kind}" Center="{centre}">{stored}</Attribute>')
        self._grids.append(f'   <Grid Name="{frame}" GridType="Uniform">{"".join(parts)}</Grid>\n')
        self._numbers.flush()
        with written_whole(self._path) as part:
            part.write_text(HEAD + "".join(self._grids) + TAIL, "utf-8")

    def _stored(self, name: str, values: np.ndarray) -> str:
        self._numbers.create_dataset(name, data=values)
        kind = "Float" if values.dtype.kind == "f" else "Char" if values.dtype.itemsize == 1 else "Int"
        size = " ".join(map(str, values.shape))
        where = f"{escape(self._path.with_suffix('.h5').name)}:/{name}"
        precision = values.dtype.itemsize
        return (
            f'<DataItem Dimensions="{size}" NumberType="{kind}" Precision="{precision}" Format="HDF">{where}</DataItem>'
        )
