"""Images a second and bytes an image of a data set; and the same bits by one worker, and by two that are killed.

    python demos/benchmarks/data_sets.py [--count 2000] [--size 128] [--shard 100]

Writes random scenes of simple shapes, with color, shadow, depth and normals, twice. One process writes them at once.
Then two workers do, by ``warpshadow dataset``, which is killed when half of the shards are whole, and run again. Their
shards are compared bit for bit; the exit status is 1 where they differ. Times include the start of the processes, but
neither compiling nor fits, which are done before. A processor's own time leaves out that in which it did other work.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks.lane_choice import cpu_text
from warpshadow.dataset import DataSet, load_recipe, write_shards

RECIPE = "images = {count}\nshard = {shard}\n[camera]\nsize = [{size}, {size}]\n"
COMMAND = (sys.executable, "-m", "warpshadow", "dataset", "--quiet")


def shards(folder: Path) -> list[Path]:
    """Those that are whole."""
    return sorted(folder.glob("train-*.tar"))


def hashes(folder: Path) -> dict[str, str]:
    """What tells whether the bits of shards are the same."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in shards(folder)}


def write_and_kill(recipe: Path, folder: Path, half: int) -> tuple[float, int]:
    """Time of two runs, the first of which is killed when so many shards are whole; and how many it left."""
    command = [*COMMAND, str(recipe), "-o", str(folder), "--workers", "2"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    began = time.perf_counter()
    process = subprocess.Popen(command, env=environment)
    while process.poll() is None and len(shards(folder)) < half:
        time.sleep(0.01)
    process.kill()
    process.wait()
    whole = len(shards(folder))
    subprocess.run(command, env=environment, check=True)
    return time.perf_counter() - began, whole


def main(count: int, size: int, shard: int) -> int:
    ws.quiet()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recipe = folder / "recipe.toml"
        recipe.write_text(RECIPE.format(count=3, size=size, shard=1))
        write_shards(DataSet(load_recipe(recipe)), folder / "warm", workers=1)
        recipe.write_text(RECIPE.format(count=count, size=size, shard=shard))
        ws.set_thread_count(1)
        began, used = time.perf_counter(), time.process_time()
        write_shards(DataSet(load_recipe(recipe)), folder / "one", workers=1)
        one, used = time.perf_counter() - began, time.process_time() - used
        written = shards(folder / "one")
        size_of_all = sum(path.stat().st_size for path in written)
        two, whole = write_and_kill(recipe, folder / "two", len(written) // 2)
        is_same = hashes(folder / "one") == hashes(folder / "two")
    load = os.getloadavg()[1]
    print(f"{cpu_text()}; load {load:.1f} on {os.cpu_count()} cores")
    print(f"{count} images of {size} × {size}, color, shadow, depth, normals, in {len(written)} shards")
    print(f"one process, one thread       {count / one:6.2f} images a second")
    print(f"  of which a processor took   {count / used:6.2f} images a second of its own time")
    print(f"two, killed after {whole:3} shards   {count / two:6.2f} images a second, both runs together")
    print(f"bytes an image, as OpenEXR    {size_of_all / count:6.0f}")
    print(f"bits of all shards            {'the same' if is_same else 'DIFFERENT'}")
    return 0 if is_same else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="number of images")
    parser.add_argument("--size", type=int, default=128, help="width and height of the images [pixels]")
    parser.add_argument("--shard", type=int, default=100, help="images in a shard")
    sys.exit(main(**vars(parser.parse_args())))
