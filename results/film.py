"""A small animation of a trained policy, for pages.

    python results/film.py runs/<directory> results/gallery/halfcheetah.gif --camera track

Films an episode as `recipes/evaluate.py video=true` does and keeps its first seconds, every second
image, at a small width. Needs the `recipes` extra and a renderer.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import imageio.v3 as imageio
import torch
from PIL import Image

from torchrl_aca.errors import RunError
from torchrl_aca.training.config import Env, checked
from torchrl_aca.training.evaluation import record_video
from torchrl_aca.training.policy import build_policy, read_policy


def animate(film: Path, output: Path, seconds: float, width: int) -> None:
    """Turns the beginning of an MP4 file into a small GIF file of half its rate."""
    rate = imageio.immeta(film)["fps"]
    images = [Image.fromarray(image) for image in imageio.imread(film)[: round(seconds * rate) : 2]]
    height = round(width * images[0].height / images[0].width)
    first, *others = (image.resize((width, height)) for image in images)
    output.parent.mkdir(parents=True, exist_ok=True)
    first.save(output, save_all=True, append_images=others, duration=round(2000 / rate), loop=0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parses the command line, films the policy and writes the animation."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="a run directory")
    parser.add_argument("output", type=Path)
    parser.add_argument("--camera", help="one of the task's cameras, such as track")
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--width", type=int, default=200)
    args = parser.parse_args(arguments)
    try:
        film_run(args)
    except RunError as error:
        raise SystemExit(f"error: {error}") from None


def film_run(args: argparse.Namespace) -> None:
    """Films the newest policy of a run and writes the animation."""
    content = read_policy(args.run)
    with TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        task = checked(Env, content["config"]["env"])
        if args.camera:
            task.kwargs = {**(task.kwargs or {}), "camera_name": args.camera}
        limit = content["config"]["eval"]["max_steps"]
        policy, cpu = build_policy(content), torch.device("cpu")
        record_video(policy, task, film, args.seed, cpu, max_steps=limit)
        animate(film, args.output, args.seconds, args.width)
    print(f"{args.output}: {content['config']['env']['name']} after {content['updates']} updates")


if __name__ == "__main__":
    main()
