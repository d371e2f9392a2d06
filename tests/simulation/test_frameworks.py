"""PyTorch and JAX: the same memory on both sides, and steps among their own work."""

import os

import numpy as np
import pytest
import warp as wp
from foreign import DT, allocates, bar

import warp_corot as wc

# JAX would take three quarters of a card, which other processes use, too.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def ordinary(device, forces, steps):
    """Positions after some steps under each of some forces [k, n, 3], with the body's own arrays."""
    sim = bar(device)
    for each in forces:
        sim.body.loads.assign(each)
        for _ in range(steps):
            sim.step()
    return sim.body.positions.numpy()


def some_forces(rng, count=4):
    return rng.uniform(-0.05, 0.05, (count, len(bar("cpu").body.mesh.points), 3)).astype(np.float32)


class TestPyTorch:
    @pytest.fixture
    def torch(self):
        return pytest.importorskip("torch")

    @pytest.mark.parametrize("form", ["[n, 3]", "[1, n, 3]", "[n, 4]", "three of seven", "vec3", "with a gradient"])
    def test_tensors_are_the_arrays(self, torch, form, device, rng):
        sim = bar(device)
        body, n = sim.body, sim.body.node_count
        shape = {"[1, n, 3]": (1, n, 3), "[n, 4]": (n, 4), "three of seven": (n, 7)}.get(form, (n, 3))
        forces, positions = (torch.zeros(shape, device=wp.device_to_torch(body.device)) for _ in range(2))
        if form == "three of seven":
            forces, positions = forces[:, 2:5], positions[:, 2:5]
        if form == "with a gradient":
            forces.requires_grad_()
        dtype = wp.vec3 if form == "vec3" else None
        body.use_loads(wp.from_torch(forces, dtype=dtype))
        body.use_positions(wp.from_torch(positions, dtype=dtype))
        assert body.loads.ptr == forces.data_ptr()
        assert body.positions.ptr == positions.data_ptr()
        given = some_forces(rng)
        for each in given:
            forces.data[..., :3] = torch.as_tensor(each)
            for _ in range(5):
                sim.step()
        found = positions[..., :3].cpu().numpy().reshape(n, 3)
        np.testing.assert_array_equal(found, ordinary(device, given, 5))
        assert np.abs(found - body.mesh.points).max() > 1e-7

    def test_the_bodys_own_arrays_as_tensors(self, torch, device):
        sim = bar(device, gravity=(0.0, -9.81, 0.0))
        x, v = wp.to_torch(sim.body.positions), wp.to_torch(sim.body.velocities)
        assert x.data_ptr() == sim.body.node_positions.ptr
        assert v.data_ptr() == sim.body.node_velocities.ptr
        sim.step()
        np.testing.assert_array_equal(x.cpu().numpy(), sim.body.positions.numpy())
        assert v.abs().max() > 0
        v.zero_()
        assert np.abs(sim.body.velocities.numpy()).max() == 0

    def test_a_tensor_itself_is_refused_with_what_to_do(self, torch):
        with pytest.raises(wc.InputError, match=r"loads is Tensor; .*wp\.from_torch"):
            bar("cpu").body.use_loads(torch.zeros(45, 3))

    @pytest.mark.parametrize("recorded", [False, True], ids=["called", "in PyTorch's graph"])
    def test_steps_on_its_stream(self, torch, recorded, device):
        """A control loop of tensors: PyTorch's work before and after is in order, and nothing is allocated."""
        if recorded and not wp.get_device(device).is_cuda:
            pytest.skip("PyTorch's graphs are for CUDA")
        sim = bar(device)
        body, where = sim.body, wp.device_to_torch(sim.device)
        forces, positions = (torch.zeros(body.node_count, 3, device=where) for _ in range(2))
        seen = torch.zeros_like(forces)
        goal = torch.as_tensor(body.mesh.points + np.array([0.0, 0.02, 0.01]), dtype=torch.float32, device=where)
        body.use_loads(wp.from_torch(forces))
        body.use_positions(wp.from_torch(positions))

        def control():
            torch.sub(goal, positions, out=forces)
            sim.step()
            seen.mul_(0.5).add_(positions)

        if not wp.get_device(device).is_cuda:
            control()
            assert not allocates(lambda: [control() for _ in range(19)])
        else:
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream), wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
                wp.synchronize_device(device)
                control()
                if recorded:
                    graph = torch.cuda.CUDAGraph()
                    with torch.cuda.graph(graph, stream=stream):
                        control()
                assert not allocates(lambda: [graph.replay() if recorded else control() for _ in range(19)])
            stream.synchronize()
        assert sim.steps == 20

        other = bar(device)
        expected = np.zeros_like(goal.cpu().numpy())
        for _ in range(20):
            other.body.loads.assign(goal.cpu().numpy() - other.body.positions.numpy())
            other.step()
            expected = np.float32(0.5) * expected + other.body.positions.numpy()
        np.testing.assert_array_equal(positions.cpu().numpy(), other.body.positions.numpy())
        np.testing.assert_array_equal(seen.cpu().numpy(), expected)


class TestJax:
    @pytest.fixture
    def jax(self, device):
        jax = pytest.importorskip("jax")
        wp.init()
        try:
            where = wp.device_to_jax(device)
        except Exception:
            pytest.skip(f"this JAX has no device {device}")
        with jax.default_device(where):
            yield jax

    @pytest.mark.parametrize("mode", ["JAX", "WARP", "NONE"])
    def test_steps_are_an_operation_of_a_compiled_function(self, jax, mode, device, rng):
        """Inside ``jit`` and ``scan``, with JAX's buffers, on its stream and in its graph."""
        if mode == "WARP" and not wp.get_device(device).is_cuda:
            pytest.skip("Warp's graphs in JAX are for CUDA")
        sim = bar(device)
        body = sim.body
        seen = []

        def advance(forces: wp.array(dtype=wp.vec3), positions: wp.array(dtype=wp.vec3)):
            body.use_loads(forces)
            body.use_positions(positions)
            seen.append((forces.ptr == body.loads.ptr, positions.ptr == body.positions.ptr))
            for _ in range(5):
                sim.step()
            body.use_loads(None)
            body.use_positions(None)

        advanced = wp.jax_callable(
            advance,
            output_dims=body.node_count,
            graph_mode=wp.JaxCallableGraphMode[mode],
            has_side_effect=True,
        )
        rollout = jax.jit(lambda forces: jax.lax.scan(lambda t, f: (t + DT, advanced(f)[0]), 0.0, forces)[1])
        given = some_forces(rng, 6)
        for half in (given[:3], given[3:]):
            history = np.asarray(rollout(half))
        assert seen
        assert all(map(all, seen))
        assert sim.steps == 30
        np.testing.assert_array_equal(history[-1], ordinary(device, given, 5))
        np.testing.assert_array_equal(history[0], ordinary(device, given[:4], 5))
        # JAX's buffers may be freed; the body does not touch them from now on.
        np.testing.assert_array_equal(body.positions.numpy(), history[-1])
        assert not body.conditions.has_loads
        assert sim.energy().elastic > 0
