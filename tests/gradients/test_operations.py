"""Static answers as operations of PyTorch and JAX against ``static_gradient``, and differences."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
from cases import CUBE, MODELS

import warp_corot as wc
from warp_corot.frameworks import torch as wc_torch

GRAVITY = (0.0, -9.8, 0.0)
OPTIONS = {"model": MODELS["corotated"](), "gravity": GRAVITY}


def held_bar(device="cpu", *, worlds=1):
    mesh = wc.TetForest.box((1, 1, 2), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.4, 10.0), worlds=worlds, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def given(body, rng):
    """The arguments, and the weights of J = sum w . x."""
    count, nodes = len(body.mesh.tets), body.node_count
    young = 500.0 * rng.uniform(0.5, 2.0, count)
    loads = 1e-4 * rng.standard_normal((nodes, 3))
    return {"young": young, "loads": loads}, rng.standard_normal((nodes, 3))


def right_gradient(body, values, weights, names):
    material = replace(body.material, young=values["young"])
    other = wc.SoftBody(body.mesh, material, device=body.device)
    other.fix(body.mesh.points[:, 2] < 1e-9)
    other.load(np.arange(body.node_count), values["loads"])
    return wc.static_gradient(other, lambda x: (float((weights * x.numpy()).sum()), weights), wrt=names, **OPTIONS)


def assert_near(found, right):
    assert found == pytest.approx(right, abs=1e-4 * np.abs(right).max())


class TestPyTorch:
    @pytest.fixture
    def torch(self):
        return pytest.importorskip("torch")

    def test_gradients_are_those_of_static_gradient(self, torch, device, rng):
        body = held_bar(device)
        values, weights = given(body, rng)
        right = right_gradient(body, values, weights, ("young", "loads"))
        tensors = {name: torch.tensor(value, requires_grad=True) for name, value in values.items()}
        x = wc.torch.static(body, options=OPTIONS, **tensors)
        assert x.shape == (body.node_count, 3)
        assert x.dtype == torch.float64
        loss = (torch.tensor(weights) * x).sum()
        loss.backward()
        assert loss.item() == pytest.approx(right.value, abs=1e-6)
        assert_near(tensors["young"].grad.numpy(), right.young)
        assert_near(tensors["loads"].grad.numpy(), right.loads)
        assert not body.displacements.numpy().any()

    def test_other_arguments(self, torch, device, rng):
        """A single modulus, rest positions, places of held nodes and gravity, along random directions, in a chain with
        other operations."""
        body = held_bar(device)
        _, weights = given(body, rng)
        weights = torch.tensor(weights)
        points = np.asarray(body.mesh.points)
        values = {
            "young": np.array(2.7),
            "rest": points,
            "boundary": points + np.array([0.0, 0.002, 0.0]),
            "gravity": np.array(GRAVITY),
        }
        ways = {"young": 0.3, "rest": 2e-4 * rng.standard_normal(points.shape), "gravity": rng.standard_normal(3)}
        ways["boundary"] = 2e-3 * rng.standard_normal(points.shape)

        def value(tensors):
            arguments = tensors | {"young": 10.0 ** tensors["young"]}
            x = wc.torch.static(body, options={"model": OPTIONS["model"]}, **arguments)
            return (weights * x).sum()

        tensors = {name: torch.tensor(each, requires_grad=True) for name, each in values.items()}
        value(tensors).backward()
        for name, way in ways.items():
            along = float((tensors[name].grad * torch.as_tensor(way)).sum())
            near, far = (
                value({n: torch.tensor(v + (k * way if n == name else 0.0)) for n, v in values.items()}).item()
                - value({n: torch.tensor(v - (k * way if n == name else 0.0)) for n, v in values.items()}).item()
                for k in (0.5, 1.0)
            )
            difference = (8.0 * near - far) / 6.0
            print(f"{name}: {along:.6g} against {difference:.6g}")
            assert along == pytest.approx(difference, rel=2e-3)

    def test_one_of_two_worlds(self, torch, device):
        """Each world has its own modulus; the J of the second one does not depend on the first."""
        body = held_bar(device, worlds=2)
        young = torch.tensor([[300.0], [900.0]], requires_grad=True)
        x = wc.torch.static(body, young=young, options=OPTIONS)
        x.reshape(2, -1, 3)[1, :, 1].sum().backward()
        assert young.grad.shape == (2, 1)
        assert young.grad[0, 0] == 0.0
        assert young.grad[1, 0] > 0.0

    def test_refusals(self, torch):
        body = held_bar()
        one = torch.tensor(500.0)
        for arguments, message in (
            ({}, "nothing is given to differentiate by"),
            ({"colour": one}, "colour is not an argument; they are young"),
            ({"loads": torch.zeros(3, 3)}, r"loads has shape \(3, 3\)"),
            ({"gravity": torch.zeros(3), "options": {"gravity": GRAVITY}}, "gravity is given twice"),
        ):
            with pytest.raises(wc.InputError, match=message):
                wc.torch.static(body, **arguments)
        with pytest.raises(wc.InputError, match="body is 3; it must be a SoftBody"):
            wc.torch.static(3, young=one)


class TestJAX:
    @pytest.fixture
    def jax(self):
        return pytest.importorskip("jax")

    def test_gradients_are_those_of_static_gradient(self, jax, device, rng):
        body = held_bar(device)
        values, weights = given(body, rng)
        right = right_gradient(body, values, weights, ("young", "loads"))

        def loss(values):
            return (weights * wc.jax.static(body, options=OPTIONS, **values)).sum()

        arrays = {name: jax.numpy.asarray(value, "float32") for name, value in values.items()}
        for function in (jax.value_and_grad(loss), jax.jit(jax.value_and_grad(loss))):
            value, found = function(arrays)
            assert value == pytest.approx(right.value, abs=1e-4)
            assert_near(np.asarray(found["young"]), right.young)
            assert_near(np.asarray(found["loads"]), right.loads)

    def test_many_at_once(self, jax, device):
        body = held_bar(device)

        def sag(young):
            return wc.jax.static(body, young=young, options=OPTIONS)[:, 1].sum()

        young = jax.numpy.array([300.0, 900.0])
        many = jax.vmap(jax.grad(sag))(young)
        assert np.asarray(many) == pytest.approx([float(jax.grad(sag)(each)) for each in young], rel=1e-4)


@pytest.mark.parametrize("name", ["torch", "jax"])
def test_a_missing_framework_is_named(name, monkeypatch):
    there = builtins.__import__

    def without(wanted, *rest, **others):
        if wanted.split(".")[0] == name:
            raise ImportError(wanted)
        return there(wanted, *rest, **others)

    monkeypatch.setattr(builtins, "__import__", without)
    wc_torch._function.cache_clear()
    with pytest.raises(wc.InputError, match=rf"wc.{name} needs .*: pip install \"warp-corot\[{name}\]\""):
        getattr(wc, name).static(held_bar(), young=np.array(500.0))
