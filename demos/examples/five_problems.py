"""The five inverse problems of the paper on meshes that ship with Warp, each with a picture.

    python demos/examples/five_problems.py [texture] [light] [pose] [deformation] [shadow] [--output out]

texture      of the ground under a bunny; and in the shadow of a bunny that the camera does not see
light        on a bunny, which then lights a bear
pose         of a bunny turned by 10° to 40° and shifted by 5% to 25% of its diagonal
deformation  of a bear that was bent, twisted and stretched, by embedded deformation
shadow       pose and deformation again, from the pixels of the ground alone

Each is solved with shadows and without (direct illumination), and its figures are printed. Targets are ray traced.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos import problems
from demos.examples.bunny import contact_sheet
from demos.problems import Case
from demos.scenes import shipped_mesh
from warpshadow import inverse

PIXELS = 256  # of a picture, across and down
SUN = (-0.75, 0.6, -0.1)


def sky() -> ws.EnvironmentMap:
    return ws.synthetic_sky(SUN, sun_strength=2.0, sun_radius=5.0)


def texture() -> list[Case]:
    return [problems.texture_case(shipped_mesh("bunny"), sky(), 1, is_hidden=hidden) for hidden in (False, True)]


def light() -> list[Case]:
    free = inverse.Light(order=None, directions=512)
    return [problems.light_case(shipped_mesh("bunny"), sky(), [shipped_mesh("bear")], light=free)]


def pose() -> list[Case]:
    return [problems.pose_case(shipped_mesh("bunny"), sky(), 1)]


def deformation() -> list[Case]:
    return [problems.deformation_case(shipped_mesh("bear"), sky(), 1)]


def shadow() -> list[Case]:
    alone = {"is_shadow_alone": True}
    return [
        problems.pose_case(shipped_mesh("bunny"), sky(), 2, **alone),
        problems.deformation_case(shipped_mesh("bear"), sky(), 2, **alone),
    ]


PROBLEMS: dict[str, Callable[[], list[Case]]] = {
    "texture": texture,
    "light": light,
    "pose": pose,
    "deformation": deformation,
    "shadow": shadow,
}


def main(names: list[str], output: Path) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    output.mkdir(parents=True, exist_ok=True)
    every: list[list[tuple[np.ndarray, str]]] = []
    for name in names or PROBLEMS:
        rows = [solve(case) for case in PROBLEMS[name]()]
        every += rows
        contact_sheet(rows, margin=58).save(output / f"{name}.png")
        print(name)
        for _, caption in (panel for row in rows for panel in row):
            print("  " + ", ".join(caption.split("\n")))
    contact_sheet(every, margin=58).save(output / "inverse.png")
    print(f"{output / 'inverse.png'}, and a picture for each problem beside it")


def solve(case: Case) -> list[tuple[np.ndarray, str]]:
    """Pictures of the target, of the start, of what fits without and with shadows found, and of the truth."""
    start, (target,) = case.problem.scene, case.problem.targets
    truth = picture(case.truth, case)
    seen = enlarged(target.image * target.weights()[..., None])
    seen[..., :3] *= np.percentile(truth[..., :3], 99) / np.percentile(seen[..., :3], 99)  # as bright as the others
    panels = [
        (seen, "target" + (", masked" if target.mask is not None else "")),
        (picture(start, case), caption("start", case.measure(start))),
    ]
    for label, visibility in (("without shadows", problems.DIRECT), ("with shadows", None)):
        began = time.perf_counter()
        result = inverse.fit(case.by(visibility), case.stages, progress=True)
        seconds = time.perf_counter() - began
        figures = caption(label, case.measure(result.scene))
        panels.append((picture(result.scene, case), f"{figures}\n{sum(map(len, result.losses))} it., {seconds:.0f} s"))
    return [*panels, (truth, "truth\nray traced")]


def caption(label: str, figures: dict[str, float]) -> str:
    return f"{label}\n" + ", ".join(f"{name} {value:.2g}" for name, value in figures.items())


def picture(scene: ws.Scene, case: Case) -> np.ndarray:
    """What was found, ray traced: a texture in plain light, light on another body, shapes where they are."""
    shown = case.shown(scene)
    return problems.ray_traced(
        dataclasses.replace(shown, camera=shown.camera.resized(PIXELS / shown.camera.width)), 512
    )


def enlarged(image: np.ndarray) -> np.ndarray:
    """An image at the size of the pictures, pixels repeated."""
    return image.repeat(PIXELS // len(image), axis=0).repeat(PIXELS // len(image), axis=1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*PROBLEMS, []], help="which problems, all by default")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the pictures")
    arguments = parser.parse_args()
    main(arguments.names, arguments.output)
