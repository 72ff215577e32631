"""Spheres, maps, caches and kernels, which scenes are prepared from."""

import time
from pathlib import Path
from typing import Annotated, Literal, Optional

import numpy as np
import typer
import warp as wp

from warpshadow.cli.console import Device, Quiet, app, check_output, clear_errors, device_of, note
from warpshadow.spheres import FitReport


@app.command()
def spheres(
    mesh: Annotated[Path, typer.Argument(help="Mesh: .obj, .ply, .stl, .glb, .gltf or .usd.")],
    count: Annotated[
        Optional[int], typer.Option(help="Number of spheres; as many as the mesh needs by default.", min=1)
    ] = None,
    error: Annotated[
        Optional[float], typer.Option(help="In place of --count: as many spheres as this relative error takes.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fit.")] = 0,
    picture: Annotated[Optional[Path], typer.Option(help="Draw the spheres in the mesh: .png.")] = None,
    output: Annotated[Optional[Path], typer.Option("-o", "--output", help="Write centers and radii: .npz.")] = None,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Fit spheres to a mesh and report how well they stand in for it; the fit is cached for later renders."""
    from warpshadow.assets.mesh_files import load_mesh
    from warpshadow.spheres import check_matplotlib, fit_spheres, plot_spheres

    with clear_errors():
        if picture is not None:
            check_output(picture, ".png")
            check_matplotlib()
        if output is not None:
            check_output(output, ".npz")
        loaded_mesh = load_mesh(mesh)
        if count is not None and error is not None:
            raise ValueError("--count, --error: got both, expected one of them")
        requested_spheres = {"count": count or "auto"} if error is None else {"error": error}
        fit = fit_spheres(loaded_mesh, seed=seed, device=device_of(device), progress=True, **requested_spheres)
        typer.echo(f"{mesh}: {loaded_mesh.vertex_count} vertices, {loaded_mesh.face_count} faces")
        report = fit.report
        remark = ", read from the cache" if report.cached else ""
        typer.echo(f"{report.sphere_count} spheres, fitted in {report.seconds:.1f} s{remark}")
        typer.echo(f"irradiance error on the ground   {report.ground_error:6.1%}")
        typer.echo(f"error of the shadow there        {report.shadow_error:6.1%}")
        typer.echo(f"irradiance error on the surface  {report.surface_error:6.1%}")
        typer.echo(f"irradiance error in the air      {report.nearby_error:6.1%}")
        typer.echo(f"surface covered                  {report.coverage:6.1%}")
        typer.echo(f"volume outside the mesh          {report.outside_volume:6.1%}")
        typer.echo(_describe_errors(report))
        if output is not None:
            fit.spheres.write(output)
        if picture is not None:
            plot_spheres(loaded_mesh, fit.spheres, picture)
        if error is not None and report.visibility_error > error:
            raise ValueError(
                f"--error: no fit reaches {error:g}; {report.sphere_count} spheres, the most that are tried, have "
                f'{report.visibility_error:.3g}; bodies that do not move can be exact: method = "ray-traced"'
            )


def _describe_errors(report: FitReport) -> str:
    """The meaning of a fit's errors for images."""
    from warpshadow.spheres.enough import MAX_SPHERES, RAGGED_ERROR

    hint = "the error on the surface counts where the body deforms, else it traces its shadow on itself"
    if report.shadow_error <= RAGGED_ERROR:
        return f"the shadow on the ground is whole, as its error is below {RAGGED_ERROR:.0%}; {hint}"
    advice = f"--count {2 * report.sphere_count}" if report.sphere_count < MAX_SPHERES else 'method = "ray-traced"'
    return (
        f"the shadow on the ground has holes, as its error is above {RAGGED_ERROR:.0%}; {advice} may mend them; {hint}"
    )


@app.command()
def envmap(
    file: Annotated[Path, typer.Argument(help="Environment map, .exr or .hdr, twice as wide as high.")],
    order: Annotated[int, typer.Option(help="Number of spherical-harmonic bands.", min=2, max=8)] = 8,
    sanitize: Annotated[
        Optional[Literal["zero", "neighbors"]], typer.Option(help="Repair NaN, Inf and negative pixels.")
    ] = None,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", help="Where to write the map; sh_path FILE by default.")
    ] = None,
    is_quiet: Quiet = False,
) -> None:
    """Print an environment map's statistics and write its spherical-harmonic reconstruction beside it."""
    from warpshadow.assets.image import write_image
    from warpshadow.assets.light import EnvironmentMap
    from warpshadow.maths import sh

    with clear_errors():
        sh_path = file.with_name(f"{file.stem}.sh{order}.exr") if output is None else output
        check_output(sh_path, ".exr")
        light = EnvironmentMap.read(file, sanitize=sanitize)
        for name, value in light.statistics().items():
            shown_numbers = " ".join(f"{number:.4g}" for number in np.array(value).ravel())
            typer.echo(f"{name.replace('_', ' '):26}{shown_numbers}")
        write_image(sh_path, sh.reconstruct_map(light.sh(order), len(light.radiance)).astype(np.float32))
        note(f"{sh_path}: reconstruction from {order**2} coefficients", is_quiet)


@app.command()
def cache(
    clear: Annotated[
        bool, typer.Option("--clear", help="Remove all but Warp's kernels; it is made again when needed.")
    ] = False,
    is_quiet: Quiet = False,
) -> None:
    """Print where spheres, shadows and kernels are cached, and how large that is."""
    from warpshadow.assets.cache import KINDS, cache_folder, cached_files

    with clear_errors():
        typer.echo(cache_folder())
        for kind, contents in KINDS.items():
            files = cached_files(kind)
            typer.echo(f"  {contents:40}{_size(files)}")
            if clear:
                for file in files:
                    file.unlink(missing_ok=True)  # another process may clear, too
        wp.init()
        kernels = Path(wp.config.kernel_cache_dir)
        typer.echo(kernels)
        typer.echo(f"  {'compiled kernels, of all that uses Warp':40}{_size([*kernels.rglob('*')])}")
        if clear:
            note(f"{cache_folder()}: cleared", is_quiet)


def _size(paths: list[Path]) -> str:
    sizes = [path.stat().st_size for path in paths if path.is_file()]
    return f"{len(sizes):6} files {sum(sizes) / 1e6:10.1f} MB"


@app.command()
def warmup(device: Device = "cpu", is_quiet: Quiet = False) -> None:
    """Compile the kernels of stills and of renderers, so that the first image need not; gradients have more."""
    from warpshadow.assets.camera import Camera
    from warpshadow.assets.light import EnvironmentMap
    from warpshadow.assets.primitives import icosphere
    from warpshadow.device.progress import progress_bar
    from warpshadow.pipeline.renderer import SceneRenderer
    from warpshadow.scene.body import Body
    from warpshadow.scene.scene import Scene
    from warpshadow.scene.visibility import METHODS, Visibility
    from warpshadow.spheres import fit_spheres

    with clear_errors():
        warp_device = device_of(device)
        mesh = icosphere(subdivisions=1)
        start = time.perf_counter()
        by_method = [Visibility.of({"method": method, "samples": 16}) for method in METHODS]
        of_stills = Visibility("ray-traced", samples=16, sampling="shared")
        with progress_bar(len(METHODS) + 2, "compiling", "stage", stays=True) as bar:
            fit_spheres(mesh, 1, steps=100, device=warp_device, cache=False, progress=False)
            bar.update()
            for visibility in (*by_method, of_stills):
                scene = Scene(
                    (Body(mesh, blockers=1),),
                    EnvironmentMap.constant(1.0),
                    Camera.look_at((0, 0, 5), (0, 0, 0), size=(8, 8)),
                    visibility,
                )
                SceneRenderer(scene, device=warp_device).render()
                bar.update()
        note(f"{warp_device.alias}: ready in {time.perf_counter() - start:.1f} s", is_quiet)
