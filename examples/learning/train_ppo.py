"""A policy learns a task by proximal policy optimisation of skrl, all on one device.

Observations, actions and rewards stay on the device of the environments. It needs `pip install
"warp-corot[envs,torch]" skrl`. Each line says how many steps all worlds have made, the mean reward of a step, and how
many of the episodes that ended succeeded.
"""

import argparse
import math
import time

from warp_corot import envs

try:
    import torch
    from skrl.agents.torch.ppo import PPO
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.resources.preprocessors.torch import RunningStandardScaler
    from skrl.utils import set_seed
    from torch import nn
except ImportError:
    raise SystemExit("this example needs PyTorch and skrl: pip install torch skrl") from None

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="Reach", choices=[kind.__name__ for kind in envs.TASKS.values()])
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("--worlds", type=int, default=64)
parser.add_argument("--rollouts", type=int, default=24, help="rollouts, each with an update")
parser.add_argument("--steps", type=int, default=64, help="steps of a rollout")
parser.add_argument("--minutes", type=float, default=math.inf, help="no rollout begins after so long")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--cells", type=int, default=1, help="factor on the cubes along each edge of the body")
parser.add_argument("--integrator", default="explicit", choices=("explicit", "implicit"))
parser.add_argument("--policy", help="a file of a policy to begin with (.pt)")
parser.add_argument("-o", "--output", help="a file for the policy (.pt)")
parser.add_argument("--episodes", type=int, default=0, help="so many episodes on each of four bodies, at the end")
parser.add_argument("--plot", help="a picture of rewards and successes over steps (.png); it needs matplotlib")
args = parser.parse_args()

set_seed(args.seed)
options = {"array": "torch", "autoreset": "same_step", "device": args.device}
env = getattr(envs, args.task)(args.worlds, cells=args.cells, integrator=args.integrator, **options)
observations, _ = env.reset(seed=args.seed)
device = observations.device
spaces = {"observation_space": env.single_observation_space, "action_space": env.single_action_space}


def network(outputs):
    inputs = spaces["observation_space"].shape[0]
    return nn.Sequential(nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, outputs))


class Policy(GaussianMixin, Model):
    def __init__(self):
        Model.__init__(self, **spaces, device=device)
        GaussianMixin.__init__(self)
        self.mean = network(self.num_actions)
        self.log_deviation = nn.Parameter(torch.full((self.num_actions,), -0.7))
        with torch.no_grad():
            self.mean[-1].weight *= 0.01

    def compute(self, inputs, role):
        return self.mean(inputs["observations"]), {"log_std": self.log_deviation}


class Value(DeterministicMixin, Model):
    def __init__(self):
        Model.__init__(self, **spaces, device=device)
        DeterministicMixin.__init__(self)
        self.value = network(1)

    def compute(self, inputs, role):
        return self.value(inputs["observations"]), {}


agent = PPO(
    models={"policy": Policy().to(device), "value": Value().to(device)},
    memory=RandomMemory(memory_size=args.steps, num_envs=args.worlds, device=device),
    cfg={
        "rollouts": args.steps,
        "learning_epochs": 5,
        "mini_batches": 4,
        "discount_factor": 0.98,
        "entropy_loss_scale": 1e-3,
        "value_loss_scale": 0.5,
        "value_clip": 0.0,
        "time_limit_bootstrap": True,
        "observation_preprocessor": RunningStandardScaler,
        "observation_preprocessor_kwargs": {"size": spaces["observation_space"], "device": device},
        "value_preprocessor": RunningStandardScaler,
        "value_preprocessor_kwargs": {"size": 1, "device": device},
    },
    device=device,
    **spaces,
)
agent.cfg.experiment.write_interval = agent.cfg.experiment.checkpoint_interval = 0
agent.init()
agent.enable_training_mode(True)
if args.policy:
    agent.load(args.policy)


def successes(cells, integrator):
    """How many of so many episodes the policy's mean ends with success, on another body or steps."""
    tried = getattr(envs, args.task)(args.episodes, cells=cells, integrator=integrator, **options)
    seen, _ = tried.reset(seed=1000)
    over = succeeded = torch.zeros(args.episodes, dtype=torch.bool, device=device)
    with torch.no_grad():
        while not over.all():
            _, outputs = agent.act(seen, None, timestep=0, timesteps=0)
            seen, _, terminated, truncated, info = tried.step(outputs["mean_actions"])
            succeeded = succeeded | (info["success"] & ~over)
            over = over | terminated | truncated
    return len(tried.scene.mesh.tets), int(succeeded.sum())


start, curve = time.perf_counter(), []
for rollout in range(args.rollouts):
    if time.perf_counter() - start > 60.0 * args.minutes:
        break
    rewards, ended, succeeded = [], 0, 0
    for step in range(rollout * args.steps, (rollout + 1) * args.steps):
        now = {"timestep": step, "timesteps": args.rollouts * args.steps}
        with torch.no_grad():
            actions, _ = agent.act(observations, None, **now)
            following, reward, terminated, truncated, info = env.step(actions)
            rewards.append(reward.mean())
            ended += int((terminated | truncated).sum())
            succeeded += int(info["success"].sum())
            # What follows is the end of an episode, not the beginning of the next.
            agent.record_transition(
                **{"observations": observations, "states": None, "actions": actions, "rewards": reward[:, None]},
                **{"next_observations": info["final_obs"], "next_states": None, "infos": info},
                **{"terminated": terminated[:, None], "truncated": truncated[:, None]},
                **now,
            )
            observations = following
        agent.post_interaction(**now)
    made, took = (rollout + 1) * args.steps * args.worlds, time.perf_counter() - start
    mean = float(torch.stack(rewards).mean())
    curve.append((made, mean, succeeded / ended if ended else math.nan))
    share = f"{100 * succeeded / ended:3.0f} % of {ended:4} episodes" if ended else "no episode ended"
    print(f"{made:8} steps, {took:6.0f} s: reward {mean:7.3f}, success {share}", flush=True)

if args.output:
    agent.save(args.output)
    print(f"wrote {args.output}")
if args.plot:
    import matplotlib.pyplot as plt

    steps, *rows = zip(*curve, strict=True)
    fig, axes = plt.subplots(1, 2, figsize=(8, 2.6), layout="constrained")
    for each, values, label in zip(axes, rows, ("mean reward of a step", "share of successes"), strict=True):
        each.plot([made / 1000 for made in steps], values, ".-")
        each.set(xlabel="thousand steps of all worlds", ylabel=label)
        each.grid(alpha=0.3)
    fig.savefig(args.plot, dpi=110)
if args.episodes:
    agent.enable_training_mode(False)
    for cells, integrator in ((1, "explicit"), (1, "implicit"), (2, "explicit"), (2, "implicit")):
        elements, succeeded = successes(cells, integrator)
        print(f"{elements} elements, {integrator} steps: {succeeded} of {args.episodes} episodes succeeded", flush=True)
assert all(math.isfinite(mean) for _, mean, _ in curve)
