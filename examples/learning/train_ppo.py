"""A policy learns a task by proximal policy optimisation (Schulman et al. 2017), all on one device, in PyTorch.

The method is written out in short. Observations, actions and rewards stay on the device of the environments. It needs
`pip install "warp-corot[envs,torch]"`. Each line says how many steps all worlds have made, the mean reward of a step,
and how many of the episodes that ended succeeded.
"""

import argparse
import time

import numpy as np

from warp_corot import envs

try:
    import torch
    from torch import nn
except ImportError:
    raise SystemExit('this example needs PyTorch: pip install "warp-corot[torch]"') from None

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="Reach", choices=[kind.__name__ for kind in envs.TASKS.values()])
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("--worlds", type=int, default=64)
parser.add_argument("--rollouts", type=int, default=24, help="rollouts, each with an update")
parser.add_argument("--steps", type=int, default=64, help="steps of a rollout")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("-o", "--output", help="a file for the policy (.pt)")
args = parser.parse_args()

DISCOUNT, TRACE, CLIP, EPOCHS, BATCHES, RATE, ENTROPY = 0.98, 0.95, 0.2, 5, 4, 1e-3, 1e-3

torch.manual_seed(args.seed)
kind = getattr(envs, args.task)
env = kind(args.worlds, array="torch", autoreset="same_step", device=args.device)
observations, _ = env.reset(seed=args.seed)
device = observations.device
inputs, outputs = env.observation_space.shape[1], env.action_space.shape[1]


class Normaliser:
    """Observations with the mean and the deviation that all so far have had."""

    def __init__(self):
        self.count, self.mean, self.square = 1e-4, torch.zeros(inputs, device=device), torch.ones(inputs, device=device)

    def update(self, given):
        share = len(given) / (self.count + len(given))
        self.count += len(given)
        self.mean += share * (given.mean(dim=0) - self.mean)
        self.square += share * ((given**2).mean(dim=0) - self.square)

    def __call__(self, given):
        deviation = (self.square - self.mean**2).clamp(min=0.0).sqrt()
        return ((given - self.mean) / (deviation + 1e-4)).clamp(-5.0, 5.0)


def network(size):
    return nn.Sequential(nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, size))


normalise = Normaliser()
actor, critic = network(outputs).to(device), network(1).to(device)
with torch.no_grad():
    actor[-1].weight *= 0.01
spread = nn.Parameter(torch.full((outputs,), -0.7, device=device))
parameters = [*actor.parameters(), *critic.parameters(), spread]
optimiser = torch.optim.Adam(parameters, lr=RATE)


def policy(seen):
    return torch.distributions.Normal(actor(seen), spread.exp())


start = time.perf_counter()
for rollout in range(args.rollouts):
    seen, done, chance, value, gain, ends, following = ([] for _ in range(7))
    ended = succeeded = 0
    with torch.no_grad():
        for _ in range(args.steps):
            normalise.update(observations)
            seen.append(normalise(observations))
            distribution = policy(seen[-1])
            done.append(distribution.sample())
            chance.append(distribution.log_prob(done[-1]).sum(dim=1))
            value.append(critic(seen[-1])[:, 0])
            observations, reward, terminated, truncated, info = env.step(done[-1])
            gain.append(reward)
            ends.append((terminated | truncated).float())
            # An episode that is cut off would have gone on; one that is over has nothing more to gain.
            following.append(critic(normalise(info["final_obs"]))[:, 0] * (~terminated).float())
            ended += int(ends[-1].sum())
            succeeded += int(info["success"].sum())
        advantage, trace = [], torch.zeros(args.worlds, device=device)
        for k in reversed(range(args.steps)):
            trace = gain[k] + DISCOUNT * following[k] - value[k] + DISCOUNT * TRACE * (1.0 - ends[k]) * trace
            advantage.insert(0, trace)
    given, acted, before, gains, values = (torch.cat(each) for each in (seen, done, chance, advantage, value))
    target, gains = gains + values, (gains - gains.mean()) / (gains.std() + 1e-8)
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(given), device=device).chunk(BATCHES):
            distribution = policy(given[chosen])
            ratio = (distribution.log_prob(acted[chosen]).sum(dim=1) - before[chosen]).exp()
            surrogate = torch.minimum(ratio * gains[chosen], ratio.clamp(1 - CLIP, 1 + CLIP) * gains[chosen])
            error = (critic(given[chosen])[:, 0] - target[chosen]) ** 2
            loss = -surrogate.mean() + 0.5 * error.mean() - ENTROPY * distribution.entropy().sum(dim=1).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimiser.step()
    made, took = (rollout + 1) * args.steps * args.worlds, time.perf_counter() - start
    mean = float(torch.stack(gain).mean())
    share = f"{100 * succeeded / ended:3.0f} % of {ended:4} episodes" if ended else "no episode ended"
    print(f"{made:8} steps, {took:6.0f} s: reward {mean:7.3f}, success {share}", flush=True)

if args.output:
    state = {"actor": actor.state_dict(), "mean": normalise.mean, "square": normalise.square}
    torch.save(state, args.output)
    print(f"wrote {args.output}")
assert np.isfinite(mean)
