"""Environments: what gymnasium asks of them, what worlds promise, and the tasks, which a policy by hand can do."""

import resource
import runpy
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import warp as wp

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

import warp_corot as wc  # noqa: E402
from warp_corot.envs import TASKS, Cut, FrankaLift, Lift, Reach, Retract, SingleEnv, Thread  # noqa: E402

#: Those that need no robot.
NAMES = [name for name, kind in TASKS.items() if kind is not FrankaLift]
KINDS = [TASKS[name] for name in NAMES]
#: A task without much in it, for what is the same in all.
QUICK = Reach


def random_actions(env, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, *env.action_space.shape)).astype(np.float32)


def episodes(env, actions, seed):
    """What ``reset`` and steps with given actions return, one after another."""
    seen = [env.reset(seed=seed)[0]]
    for each in actions:
        observations, rewards, terminated, truncated, _ = env.step(each)
        seen += [observations, rewards, terminated, truncated]
    return seen


def succeeded(env, seed):
    """Whether the policy by hand succeeds in the first episode of each world."""
    observations, _ = env.reset(seed=seed)
    found, over = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
    while not over.all():
        observations, _, terminated, truncated, info = env.step(env.scripted_actions(observations))
        found |= ~over & info["success"]
        over |= terminated | truncated
    return found


# --- what gymnasium asks -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_single_environments_pass_the_checker(name):
    env = gymnasium.make(name, device="cpu").unwrapped
    with warnings.catch_warnings():
        # Of observations without bounds.
        warnings.simplefilter("ignore", UserWarning)
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("name", NAMES)
def test_spaces_and_arrays(name, device):
    env = gymnasium.make_vec(name, num_envs=3, device=device)
    assert isinstance(env, TASKS[name])
    observations, info = env.reset(seed=1)
    assert observations in env.observation_space
    assert info == {}
    env.action_space.seed(2)
    observations, rewards, terminated, truncated, info = env.step(env.action_space.sample())
    assert observations in env.observation_space
    assert rewards.shape == terminated.shape == truncated.shape == info["success"].shape == (3,)
    assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float32, bool, bool)
    assert sum(place.stop - place.start for place in env.columns.values()) == observations.shape[1]


def test_the_next_step_begins_again():
    env = QUICK(2, device="cpu", max_episode_steps=3)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    env.reset(seed=4)
    still = np.zeros(env.action_space.shape, np.float32)
    ends = [env.step(still) for _ in range(8)]
    assert [end[3].tolist() for end in ends] == [[k % 4 == 2] * 2 for k in range(8)]
    begun, rewards = ends[3][:2]
    assert (rewards == 0.0).all()
    assert (begun[:, env.columns["time"]] == 0.0).all()
    assert (begun[:, env.columns["tool0.velocity"]] == 0.0).all()
    # The second episode of these seeds begins elsewhere than the first, and as it does after a reset.
    first, _ = env.reset(seed=4)
    second, _ = env.reset()
    assert (first != begun).any(axis=1).all()
    np.testing.assert_array_equal(second, begun)


def test_the_same_step_begins_again():
    next_step, same_step = (
        QUICK(2, device="cpu", max_episode_steps=3, autoreset=a) for a in ("next_step", "same_step")
    )
    assert same_step.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    next_step.reset(seed=4)
    same_step.reset(seed=4)
    still = np.zeros(same_step.action_space.shape, np.float32)
    for step in range(3):
        expected, found = next_step.step(still), same_step.step(still)
        np.testing.assert_array_equal(found[4]["final_obs"], expected[0])
        np.testing.assert_array_equal(found[3], [step == 2] * 2)
    np.testing.assert_array_equal(found[0], next_step.step(still)[0])


def test_a_mask_resets_its_worlds_only():
    env = QUICK(3, device="cpu")
    env.reset(seed=0)
    actions = random_actions(env, 4)
    for each in actions[:3]:
        before = env.step(each)[0]
    after, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert after[1, env.columns["time"]] == 0.0


@pytest.mark.parametrize("array", ["warp", "torch"])
def test_arrays_of_other_kinds(array, device):
    torch = pytest.importorskip("torch") if array == "torch" else None
    kinds = {"array": array, "device": device}
    theirs, ours = QUICK(2, **kinds), QUICK(2, device=device)
    theirs.reset(seed=3)
    ours.reset(seed=3)
    for each in random_actions(ours, 3):
        given = torch.from_numpy(each) if torch else wp.array(each, dtype=wp.float32, device=device)
        found = theirs.step(given)[:4]
        assert all(isinstance(a, torch.Tensor if torch else wp.array) for a in found)
        for a, b in zip(found, ours.step(each)[:4], strict=True):
            np.testing.assert_array_equal(a.numpy() if device == "cpu" or not torch else a.cpu().numpy(), b)


def test_wrong_arguments_are_refused():
    for wrong in ({"array": "jax"}, {"autoreset": "never"}, {"ranges": {"colour": (0, 1)}}, {"render_mode": "human"}):
        with pytest.raises(wc.InputError):
            QUICK(1, device="cpu", **wrong)
    with pytest.raises(wc.InputError, match="young"):
        QUICK(1, device="cpu", ranges={"young": (2.0, 1.0)})
    env = QUICK(2, device="cpu")
    with pytest.raises(wc.InputError, match="seed has 3"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(wc.InputError, match="reset_mask"):
        env.reset(options={"reset_mask": [True]})
    with pytest.raises(wc.InputError, match="actions"):
        env.step(np.zeros((2, 7), np.float32))


def test_a_picture_shows_the_tissue():
    env = Retract(1, device="cpu", render_mode="rgb_array")
    env.reset(seed=0)
    (picture,) = env.render()
    assert picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


# --- what worlds promise -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_each_world_is_a_single_environment_to_the_bit(kind):
    """Also where contact, grasps and resets of other worlds come in between."""
    steps = 30
    together = kind(3, device="cpu", threads=1, max_episode_steps=11)
    actions = random_actions(together, steps)
    expected = episodes(together, actions, seed=5)
    again = episodes(together, actions, seed=5)
    for a, b in zip(expected, again, strict=True):
        np.testing.assert_array_equal(a, b)
    for world in range(3):
        alone = kind(1, device="cpu", threads=1, max_episode_steps=11)
        found = episodes(alone, actions[:, world : world + 1], seed=5 + world)
        for a, b in zip(expected, found, strict=True):
            np.testing.assert_array_equal(a[world], b[0])


def test_numbers_are_drawn_within_their_ranges(device):
    env = Retract(64, device=device, ranges={"goal_z": (0.03, 0.03), "young": (6e3, 9e3)})
    env.reset(seed=0)
    drawn = env.drawn
    for name, (low, high) in env.ranges.items():
        assert (drawn[name] >= np.float32(low)).all()
        assert (drawn[name] <= np.float32(high)).all()
    assert (drawn["goal_z"] == np.float32(0.03)).all()
    assert len(np.unique(drawn["young"])) > 60
    kept = drawn["young"].copy()
    env.reset(options={"reset_mask": np.zeros(64, bool)})
    np.testing.assert_array_equal(env.drawn["young"], kept)
    env.reset()
    assert (env.drawn["young"] != kept).any()
    np.testing.assert_array_equal(drawn["young"], kept)  # not a view
    # What the tissue is made of.
    drawn = env.drawn
    mu = env.sim.body.discretization.mu.numpy().reshape(64, -1)
    np.testing.assert_allclose(mu, np.broadcast_to(drawn["young"][:, None] / 2.8, mu.shape), rtol=1e-6)


def test_tissue_begins_at_rest_where_its_pose_says():
    env = Lift(4, device="cpu")
    observations, _ = env.reset(seed=0)
    mesh, drawn = env.scene.mesh, env.drawn
    corners = observations[:, env.columns["points"]].reshape(4, 8, 3)
    middle = np.array([0.015, 0.012, 0.012])
    shift = np.stack([drawn["shift_x"], drawn["shift_y"], np.zeros(4)], axis=1)
    np.testing.assert_allclose(corners.mean(axis=1), middle + shift, atol=1e-7)
    # A turned body is not strained; float32 rounds strains to about 1e-6.
    assert env.sim.von_mises().max() < 1e-4 * drawn["young"].min()
    assert mesh.points.shape[0] == env.sim.body.world_node_count


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_a_lost_world_begins_again_and_leaves_the_others(autoreset):
    envs = [QUICK(3, device="cpu", threads=1, autoreset=autoreset) for _ in range(2)]
    for env in envs:
        env.reset(seed=0)
    actions = random_actions(envs[0], 6)
    for k, each in enumerate(actions):
        if k == 2:
            body = envs[0].sim.body
            free = ~body.constrained.reshape(3, -1)[1]
            body.world(1).velocities.assign(np.where(free[:, None], np.nan, 0.0) * np.ones(3))
        found, expected = (env.step(each) for env in envs)
        np.testing.assert_array_equal(found[0][[0, 2]], expected[0][[0, 2]])
        assert found[2].tolist() == [False, k == 2, False]
        assert found[4]["lost"].tolist() == [0, k == 2, 0]
        assert found[1][1] == 0.0 or k != 2
    assert np.isfinite(found[0]).all()


def random_episodes(kind, worlds, count, steps):
    """Memory in use [kB] at several times while ``count`` episodes with random actions are made."""
    env = kind(worlds, device="cpu", max_episode_steps=steps)
    env.reset(seed=0)
    rng = np.random.default_rng(1)
    used, done = [], 0
    while done < count:
        observations, rewards, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
        done += int((terminated | truncated).sum())
        used.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return used


@pytest.mark.parametrize("kind", KINDS)
def test_random_actions_keep_everything_finite(kind):
    random_episodes(kind, 8, 16, 20)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_ten_thousand_random_episodes_take_no_more_memory(kind):
    """2,000 of each task; the largest memory in use grows by less than 2 MB after the first fifth."""
    used = random_episodes(kind, 100, 2000, 25)
    assert used[-1] - used[len(used) // 5] < 2000


# --- tasks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_policy_by_hand_succeeds(kind):
    assert succeeded(kind(6, device="cpu"), seed=0).sum() >= 5


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_policy_by_hand_succeeds_for_a_hundred_seeds(kind):
    assert succeeded(kind(100, device="cpu"), seed=1000).sum() >= 95


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_random_actions_hardly_ever_succeed(kind):
    """Else a task would be none."""
    env = kind(50, device="cpu")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    found = np.zeros(50, bool)
    for _ in range(env.max_episode_steps):
        found |= env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))[4]["success"]
    assert found.sum() <= 5


def test_a_bruise_ends_the_episode():
    env = QUICK(1, device="cpu", ranges={"start_x": (0.01, 0.01), "turn": (0.0, 0.0)})
    env.reset(seed=0)
    for _ in range(60):
        observations, reward, terminated, _, info = env.step(np.array([[0.0, 0.0, -1.0]], np.float32))
        if terminated[0]:
            break
    assert terminated[0]
    assert not info["success"][0]
    assert observations[0, env.columns["stress"]] > 1.0
    assert reward[0] < -5.0


def test_gripper_supports_and_ground_carry_the_weight(device):
    env = Retract(2, device=device, ranges={"young": (1e4, 1.2e4), "goal_z": (0.06, 0.06)})
    observations, _ = env.reset(seed=0)
    for k in range(190):
        actions = env.scripted_actions(observations)
        if k >= 40:
            # Still, with the gripper closed, before the goal is reached.
            actions[:, :3] = 0.0
        observations, *_ = env.step(actions)
    assert (observations[:, env.columns["closed"]] == 1.0).all()
    on_gripper = observations[:, env.columns["tool0.force"]]
    ground = env.scene.obstacles[0].wrench.numpy()[:, :3]
    supports = env.sim.body.reactions.numpy().reshape(2, -1, 3).sum(axis=1)
    weight = 9.81 * float(env.sim.body.masses.sum()) / 2
    # On the gripper and the ground acts what they carry; motion is damped out but for about a hundredth of the weight.
    balance = supports - on_gripper - ground - [0.0, 0.0, weight]
    assert np.abs(balance).max() < 0.03 * weight
    assert (-on_gripper[:, 2] > 0.2 * weight).all()


def test_steps_are_implicit_if_asked():
    env = QUICK(4, device="cpu", integrator="implicit")
    assert isinstance(env.sim.integrator, wc.BackwardEuler)
    assert succeeded(env, seed=0).sum() >= 3


@pytest.mark.parametrize("kind", [Lift, Thread], ids=lambda kind: kind.__name__)
def test_fast_thin_tools_have_more_implicit_steps(kind):
    """Fingers and the plate of the gripper could pass through tissue in one of two steps."""
    env = kind(1, device="cpu", integrator="implicit")
    env.reset(seed=0)
    env.step(np.ones((1, env.task.actions), np.float32))
    assert env.substeps > 2


def cut_through(env, seed):
    """The last step of an episode of the policy by hand, and the sum of rewards."""
    observation, _ = env.reset(seed=seed)
    total = 0.0
    while True:
        observation, reward, terminated, truncated, info = env.step(env.scripted_actions(observation))
        total += reward
        if terminated or truncated:
            return observation, total, info["success"]


def test_a_blade_cuts_along_a_line():
    """In the whole way's area, with a reward that says how precisely, and twice the same from the same seed."""
    env = Cut(device="cpu", threads=1)
    observation, total, success = cut_through(env, 3)
    assert success
    assert env.body.pieces == 2
    share, astray = observation[env.columns["share"]][0], observation[env.columns["astray"]][0]
    assert share == pytest.approx(1.0, abs=0.1)
    assert 10.0 < total < 20.0 * (1.0 - 0.1 * astray / 0.003)
    np.testing.assert_array_equal(cut_through(env, 3)[0], observation)


def test_a_cut_astray_ends_the_episode():
    env = Cut(device="cpu", level=4, ranges={"front": (0.03, 0.03), "back": (0.03, 0.03), "start_x": (0.02, 0.02)})
    env.reset(seed=0)
    for _ in range(30):
        _, _, terminated, _, info = env.step(np.float32([0.0, 1.0, 0.0]))
        if terminated:
            break
    assert terminated
    assert not info["success"]


def test_the_environment_of_a_cut_passes_the_checker():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        check_env(gymnasium.make("warp_corot/Cut-v0", device="cpu", level=4).unwrapped, skip_render_check=True)


@pytest.mark.slow
def test_a_blade_cuts_along_a_hundred_lines():
    env = Cut(device="cpu")
    assert sum(cut_through(env, seed)[2] for seed in range(1000, 1100)) >= 95


@pytest.mark.slow  # MuJoCo-Warp is compiled for minutes
def test_an_arm_lifts_a_block(device):
    pytest.importorskip("mujoco_warp")
    env = FrankaLift(8, device=device)
    assert succeeded(env, seed=0).sum() >= 7
    # It bears the block's weight, and its fingers give way as the stiffness of their motors says.
    env = FrankaLift(1, device=device)
    observations, _ = env.reset(seed=0)
    for _ in range(70):
        observations, *_ = env.step(env.scripted_actions(observations))
    for _ in range(20):
        observations, *_ = env.step(np.zeros((1, 4), np.float32))
    left, right, push, pull = env.seen(
        observations, *(f"tool{k}.{name}" for name in ("position", "force") for k in (0, 1))
    )
    assert env.middles(observations)[0, 0, 2] > 0.02
    assert -(push + pull)[0, 2] == pytest.approx(9.81 * env.sim.body.masses.sum(), rel=0.05)
    apart = (right - left)[0, 0] - env._arms.aims.numpy()[0, 3]
    assert 1000.0 * apart == pytest.approx(0.5 * (pull - push)[0, 0], rel=0.05)
    check_env(gymnasium.make("warp_corot/FrankaLift-v0", device=device).unwrapped, skip_render_check=True)


def test_a_single_environment_is_a_world():
    single, worlds = SingleEnv(QUICK, device="cpu"), QUICK(1, device="cpu")
    first, _ = single.reset(seed=3)
    np.testing.assert_array_equal(first, worlds.reset(seed=3)[0][0])
    action = np.array([0.3, -0.2, -0.5], np.float32)
    observation, reward, *_, info = single.step(action)
    found = worlds.step(action[None])
    np.testing.assert_array_equal(observation, found[0][0])
    assert reward == found[1][0]
    assert info == {"success": False, "lost": 0}


def test_the_example_trains(device, tmp_path, monkeypatch, capsys):
    """A short run: whether a policy learns shows in a long one only."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("skrl")
    script, output = Path(__file__).parents[2] / "examples" / "learning" / "train_ppo.py", tmp_path / "policy.pt"
    options = ["--device", device, "--worlds", "4", "--rollouts", "2", "--steps", "8", "-o", str(output)]
    monkeypatch.setattr(sys, "argv", [str(script), *options])
    runpy.run_path(str(script), run_name="__main__")
    lines = [line for line in capsys.readouterr().out.splitlines() if "success" in line or "no episode" in line]
    assert len(lines) == 2
    assert {"policy", "value", "observation_preprocessor"} <= set(torch.load(output, weights_only=False))
