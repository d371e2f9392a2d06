"""Scans from files: the same volume in every format, errors and warnings."""

import os
import warnings

import numpy as np
import pytest
from volumes import SPACING, affine_of, ball, blobs, turned

from warp_corot.domain import Domain
from warp_corot.errors import InputError


def test_nifti_in_its_own_unit_and_place(tmp_path, device, rng):
    nibabel = pytest.importorskip("nibabel")
    volume = blobs(rng)
    affine = affine_of(turned(rng), 1e3 * SPACING, (10.0, 20.0, -30.0))
    for name, unit, factor in (("a.nii", "mm", 1e-3), ("b.nii.gz", "meter", 1.0), ("c.nii", "unknown", None)):
        image = nibabel.Nifti1Image(volume, np.diag([1e-3 / factor if factor else 1.0] * 3 + [1.0]) @ affine)
        image.header.set_xyzt_units(unit)
        nibabel.save(image, tmp_path / name)
    expected = Domain.from_labels(volume, affine=affine, unit="mm", device=device)
    points = expected.bounds[0] + rng.uniform(-0.5, 1.5, (1000, 3)) * np.ptp(expected.bounds, axis=0)
    for name in ("a.nii", "b.nii.gz"):
        domain = Domain.from_labels(tmp_path / name, device=device)
        # The format stores its matrix in float32.
        assert np.allclose(domain.phi(points), expected.phi(points), atol=1e-5)
        assert any("as the file says" in line for line in domain.report())
    with pytest.raises(InputError, match=r"c\.nii: the file names no unit of length; give unit='mm'"):
        Domain.from_labels(tmp_path / "c.nii")
    domain = Domain.from_labels(tmp_path / "c.nii", unit="mm", device=device)
    assert np.allclose(domain.phi(points), expected.phi(points), atol=1e-5)


def test_the_same_scan_in_four_formats(tmp_path, rng):
    """ITK writes them, and itself converts its left-posterior-superior to NIfTI's directions."""
    sitk = pytest.importorskip("SimpleITK")
    pytest.importorskip("nibabel")
    volume = blobs(rng)
    image = sitk.GetImageFromArray(volume.transpose(2, 1, 0))
    image.SetSpacing((1e3 * SPACING).tolist())
    image.SetDirection(turned(rng).ravel().tolist())
    image.SetOrigin((10.0, 20.0, -30.0))
    domains = []
    for suffix in (".nii.gz", ".mha", ".mhd", ".nrrd"):
        sitk.WriteImage(image, str(tmp_path / f"scan{suffix}"))
        domains.append(Domain.from_labels(tmp_path / f"scan{suffix}", unit="mm"))
    size = np.ptp(domains[0].bounds, axis=0)
    points = domains[0].bounds[0] + rng.uniform(-0.5, 1.5, (1000, 3)) * size
    for domain in domains[1:]:
        assert np.allclose(domain.phi(points), domains[0].phi(points), atol=1e-5)
        assert domain.label_names == ("1", "7")
    with pytest.raises(InputError, match=r"scan\.mha: the file names no unit"):
        Domain.from_labels(tmp_path / "scan.mha")


@pytest.mark.parametrize("where", ["points", "cells"])
def test_vtk_images(where, tmp_path, rng):
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    volume = blobs(rng)
    grid = vtkImageData()
    first, more = (3, -2, 5), 0 if where == "points" else 1
    grid.SetExtent(*np.ravel([[a, a + n - 1 + more] for a, n in zip(first, volume.shape, strict=True)]).tolist())
    grid.SetSpacing(*(1e3 * SPACING).tolist())
    grid.SetOrigin(10.0, 20.0, -30.0)
    array = numpy_to_vtk(volume.ravel(order="F"), deep=True)
    array.SetName("tissue")
    (grid.GetPointData() if where == "points" else grid.GetCellData()).SetScalars(array)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(tmp_path / "scan.vti"))
    writer.SetInputData(grid)
    writer.Write()
    origin = np.array([0.01, 0.02, -0.03]) + SPACING * (np.array(first) + 0.5 * more)
    expected = Domain.from_labels(volume, SPACING, origin=origin)
    domain = Domain.from_labels(tmp_path / "scan.vti", unit="mm")
    points = expected.bounds[0] + rng.random((1000, 3)) * np.ptp(expected.bounds, axis=0)
    assert np.allclose(domain.phi(points), expected.phi(points), atol=1e-5)
    whole = (tmp_path / "scan.vti").read_bytes()
    for bad in (whole[: len(whole) // 2], b"words", b"<VTKFile></VTKFile>", b""):
        (tmp_path / "bad.vti").write_bytes(bad)
        with pytest.raises(InputError, match=r"bad\.vti: is not a \.vti file"):
            Domain.from_labels(tmp_path / "bad.vti", unit="mm")


def test_a_body_cut_off_by_the_scan_and_in_pieces_is_said(rng):
    volume = np.zeros((9, 8, 7), int)
    volume[0:3, 2:4, 2:4] = 1
    volume[5:7, 2:4, 2:4] = 1
    said = " ".join(Domain.from_labels(volume, SPACING).report())
    assert "20 in 2 pieces, the largest has 60.00%" in said
    assert "end of the volume along voxel axis x" in said


def test_a_unit_taken_wrongly_draws_a_warning():
    volume, _ = ball(0.1)
    with pytest.warns(UserWarning, match=r"give unit='mm'"):
        Domain.from_labels(volume, 1e3 * SPACING)
    with pytest.warns(UserWarning, match="is its unit right"):
        Domain.from_labels(volume, 1e-3 * SPACING)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Domain.from_labels(volume, SPACING, unit="mm")  # as asked for


VOLUME = np.pad(np.ones((2, 2, 2), int), 1)
NAN = np.where(VOLUME > 0, np.nan, 0.0)
SHARES = {"a": 0.9 * VOLUME}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Domain.from_labels(VOLUME), r"has no spacing; give spacing=\(dx, dy, dz\)"),
        (lambda: Domain.from_labels(VOLUME, (1, 1, 0)), r"spacing is \(1, 1, 0\)"),
        (lambda: Domain.from_labels(VOLUME, (1, 1)), r"spacing is \(1, 1\)"),
        (lambda: Domain.from_labels(VOLUME, SPACING, origin=(0, np.nan, 0)), "origin is"),
        (lambda: Domain.from_labels(VOLUME, SPACING, affine=np.eye(4)), "affine is given with spacing or origin"),
        (lambda: Domain.from_labels(VOLUME, affine=np.zeros((4, 4))), "last row"),
        (lambda: Domain.from_labels(VOLUME, affine=np.diag([1, 1, 0, 1])), "has no spacing"),
        (lambda: Domain.from_labels(VOLUME, affine=[[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "plane"),
        (lambda: Domain.from_labels(VOLUME, SPACING, unit="kPa"), "unit is 'kPa'"),
        (lambda: Domain.from_labels(VOLUME, SPACING, labels={"liver": 3}), r"label 3 \('liver'\) .*there are 0, 1"),
        (lambda: Domain.from_labels(VOLUME, SPACING, labels={"a": 1, "b": 1}), "given both to 'a' and 'b'"),
        (lambda: Domain.from_labels(VOLUME, SPACING, labels={"a": []}), "'a' has no numbers"),
        (lambda: Domain.from_labels(VOLUME, SPACING, labels=[1]), "must give numbers by name"),
        (lambda: Domain.from_labels(VOLUME, SPACING, smoothing=-1.0), "smoothing is -1.0"),
        (lambda: Domain.from_labels(VOLUME, SPACING, up_axis="S"), "up_axis is 'S'"),
        (lambda: Domain.from_labels(0 * VOLUME, SPACING), "labels is {}|empty"),
        (lambda: Domain.from_labels(VOLUME[:0], SPACING), r"shape \(0, 4, 4\)"),
        (lambda: Domain.from_labels(VOLUME[0], SPACING), r"shape \(4, 4\)"),
        (lambda: Domain.from_labels(VOLUME.astype(str), SPACING), "labels must be integers"),
        (lambda: Domain.from_labels(VOLUME * 1j, SPACING), "complex128; labels must be integers"),
        (lambda: Domain.from_labels(NAN, SPACING), r"voxel \(1, 1, 1\) of the volume is nan"),
        (lambda: Domain.from_labels(0.3 * VOLUME, SPACING), "is 0.3; labels must be integers.*from_probabilities"),
        (lambda: Domain.from_probabilities({}, SPACING), "maps is empty"),
        (lambda: Domain.from_probabilities(SHARES), "has no spacing"),
        (lambda: Domain.from_probabilities({"a": 255 * VOLUME}, SPACING), "'a' runs from 0 to 255; it must"),
        (lambda: Domain.from_probabilities({"a": NAN}, SPACING), "'a' runs from nan"),
        (lambda: Domain.from_probabilities({**SHARES, "b": VOLUME[1:]}, SPACING), r"'b' has shape \(3, 4, 4\)"),
        (lambda: Domain.from_probabilities({"a": 0.4 * VOLUME}, SPACING), "likelier inside"),
        (lambda: Domain.from_probabilities(SHARES, SPACING, certain=0), "certain is 0"),
    ],
)  # fmt: skip
def test_bad_volumes_are_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as raised:
        make()
    assert "\n" not in str(raised.value)


def test_bad_files_are_refused_in_one_line(tmp_path):
    for name in ("a.nii", "a.nii.gz", "a.mha", "a.nrrd", "a.vti"):
        path = tmp_path / name
        with pytest.raises(InputError, match=f"{name}: no such file"):
            Domain.from_labels(path)
        path.write_bytes(bytes(range(256)) * 9)
        with pytest.raises(InputError, match=f"{name}: (is not a|reading)") as raised:
            Domain.from_labels(path, unit="mm")
        assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match="is a folder"):
        Domain.from_labels(tmp_path)
    with pytest.raises(InputError, match=r"unknown format \.py; it must be \.nii\.gz"):
        Domain.from_labels(__file__)


@pytest.mark.slow
def test_the_brain_of_nilearn():
    """MNI ICBM 152: 1 mm voxels, a brain of about 1.7 l, nearly symmetric about its middle plane x = 0."""
    nilearn = pytest.importorskip("nilearn")
    maps = os.path.join(os.path.dirname(nilearn.__file__), "datasets/data/mni_icbm152_%s_tal_nlin_sym_09a_converted")
    files = {"grey": (maps % "gm") + ".nii.gz", "white": (maps % "wm") + ".nii.gz"}
    brain = Domain.from_probabilities(files, certain=255, unit="mm", smoothing=0.5e-3)
    points = np.random.default_rng(0).uniform(*brain.bounds, (200_000, 3))
    inside = brain.phi(points) < 0
    assert 1.2e-3 < inside.mean() * np.prod(np.ptp(brain.bounds, axis=0)) < 2.0e-3
    mirrored = brain.phi(points * [-1, 1, 1])
    assert np.abs(mirrored - brain.phi(points)).mean() < 1e-3
    assert set(np.unique(brain.labels_at(points))) == {0, 1, 2}
