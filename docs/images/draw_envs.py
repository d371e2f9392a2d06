"""Draws the films of the environments: envs_retract.gif and so on, in some minutes on a CPU.

python docs/images/draw_envs.py [NAME ...] [--sheet FOLDER]: all, or some by name; the policy by hand does the tasks. A
sheet shows some frames of a film.
"""

import argparse
from pathlib import Path

from PIL import Image

from warp_corot.envs import TASKS as KINDS
from warp_corot.envs import Cut, SingleEnv

IMAGES = Path(__file__).resolve().parent
#: Steps from one picture to the next, most frames and colours of a film, and the time that each frame is shown [ms].
EVERY, MOST, COLORS, SHOWN = 4, 22, 32, 100
#: Seed of the episodes that are shown.
SEED = 3
TASKS = {kind.__name__.lower(): kind for kind in (*KINDS.values(), Cut)}


def frames(kind):
    """Pictures of an episode."""
    options = {"device": "cpu", "render_mode": "rgb_array"}
    env = Cut(**options) if kind is Cut else SingleEnv(kind, **options)
    observation, _ = env.reset(seed=SEED)
    found, over, step = [env.render()], False, 0
    while not over:
        observation, _, terminated, truncated, info = env.step(env.scripted_actions(observation))
        over, step = terminated or truncated, step + 1
        if step % EVERY == 0 or over:
            found.append(env.render())
    print(f"{kind.__name__}: {step} steps, success {info['success']}", flush=True)
    return [Image.fromarray(each) for each in found]


def sheet(pictures, path, count=9, across=3):
    """Some frames beside one another."""
    width, height = pictures[0].size
    whole = Image.new("RGB", (across * width, -(-count // across) * height), "white")
    for k in range(count):
        whole.paste(pictures[k * (len(pictures) - 1) // (count - 1)], (k % across * width, k // across * height))
    whole.save(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *TASKS], help="tasks")
    parser.add_argument("--sheet", help="folder for sheets")
    args = parser.parse_args()
    for name in args.names or TASKS:
        pictures = frames(TASKS[name])
        chosen = [pictures[k] for k in sorted({round(k * (len(pictures) - 1) / MOST) for k in range(MOST + 1)})]
        small = [each.resize((320, 240), Image.Resampling.LANCZOS) for each in chosen]
        small = [each.quantize(COLORS, dither=Image.Dither.NONE) for each in small]
        path = IMAGES / f"envs_{name}.gif"
        small[0].save(path, save_all=True, append_images=small[1:], duration=SHOWN, loop=0, optimize=True)
        print(f"wrote {path.name}, {path.stat().st_size / 1000:.0f} kB")
        if args.sheet:
            sheet(pictures, Path(args.sheet) / f"envs_{name}.png")


if __name__ == "__main__":
    main()
