"""Label volumes in arrays, like scans."""

import numpy as np
from scipy.ndimage import gaussian_filter

#: In no simple ratio, so that few voxels have equal distances.
SPACING = np.array([0.0100, 0.0143, 0.0237])


def ball(radius: float, spacing=SPACING, half: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Voxels whose centres are in a ball about the middle, and the position of the first voxel's."""
    count = (2 * half / np.asarray(spacing)).astype(int)
    axes = [(np.arange(n) - (n - 1) / 2) * s for n, s in zip(count, spacing, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return (np.linalg.norm(x, axis=-1) < radius).astype(np.uint8), np.array([a[0] for a in axes])


def blobs(rng, shape=(20, 16, 12)) -> np.ndarray:
    """Two labels in smooth shapes without any symmetry."""
    smooth = gaussian_filter(rng.standard_normal(shape), 2.5)
    volume = np.digitize(smooth, np.quantile(smooth, [0.6, 0.8])).astype(np.int16)
    return np.where(volume == 2, 7, volume)


def turned(rng) -> np.ndarray:
    """A random rotation."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def affine_of(directions: np.ndarray, spacing=SPACING, origin=(0.0, 0.0, 0.0)) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = directions * spacing
    affine[:3, 3] = origin
    return affine
