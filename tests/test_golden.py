"""The golden scene: 400 receivers on and around a bunny among 64 spheres, against values computed in float64."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths import directions as cells
from warpshadow.maths import sh
from warpshadow.stages.light.transfer import directional_transfer, sh_transfer
from warpshadow.stages.visibility import directional, exponential, log_sh

# The golden log-SH has no corners rounded off (see test_log_sh.py: up to 0.6% of one cap near cos θ = 0.916), so
# single rows may be off by 1.2e-4 (eigen; cap: 4e-7), all of them together by 3e-5.
LOG_SH = 1e-4
LOG_SH_ROW = 3e-4
# The golden exponential is converged; quadratic with threshold 1/8 is within 1e-4 of it, rounding included.
IRRADIANCE = 3e-4
# Rounding; measured 2e-7, and 2.1e-6 on a GPU, which leaves out the rest of light receiver by receiver.
DIRECTIONAL = 4e-6


@pytest.fixture(scope="module")
def golden(golden_data):
    with np.load(golden_data / "golden_visibility.npz") as data:
        return {name: data[name].astype(float) for name in data}


def relative(got, expected):
    return np.linalg.norm(got - expected) / np.linalg.norm(expected)


def geometry(golden, device, *, has_normals):
    vec3 = {"dtype": wp.vec3, "device": device}
    normals = wp.array(golden["normals"][None], **vec3)
    return (
        wp.array(golden["points"][None], **vec3),
        normals if has_normals else None,
        wp.array(golden["sphere_centers"][None], **vec3),
        wp.array(golden["sphere_radii"][None].astype(np.float32), device=device),
    ), normals


def log_sh_irradiance(golden, log, device, *, has_normals=False, **options):
    """∫ L V max(n·ω, 0) dω, all in SH of order 8 [receiver]."""
    arguments, normals = geometry(golden, device, has_normals=has_normals)
    visibility = exponential.exponentiate(log_sh.accumulate(*arguments, order=8, log=log), **options)
    transfer = sh_transfer(visibility, normals, order=8).numpy()[0]
    return np.pi * transfer @ golden["light_sh"]


def directional_irradiance(golden, count, device):
    arguments, normals = geometry(golden, device, has_normals=True)
    directions = cells.fibonacci(count)
    transmittance = directional.transmittance(*arguments, directions)
    transfer = directional_transfer(transmittance, normals, directions).numpy()[0]
    return np.pi * transfer @ (sh.evaluate(8, directions) @ golden["light_sh"])


@pytest.mark.parametrize("log, name", [("cap", "log_sh_cap_eps3"), ("eigen", "log_sh_eigen_delta005")])
def test_log_visibility_is_the_golden_one(log, name, golden, device):
    arguments, _ = geometry(golden, device, has_normals=False)
    rows = log_sh.accumulate(*arguments, order=8, log=log).numpy()[0]
    assert relative(rows, golden[name]) < LOG_SH
    norms = np.linalg.norm(golden[name], axis=1)
    assert (np.linalg.norm(rows - golden[name], axis=1) < LOG_SH_ROW * norms).all()


@pytest.mark.slow
@pytest.mark.parametrize("log, name", [("cap", "log_sh_cap_eps3"), ("eigen", "log_sh_eigen_delta005")])
def test_the_float64_twin_is_the_golden_one_to_twelve_digits(log, name, golden):
    values = (golden[key] for key in ("sphere_centers", "sphere_radii"))
    assert relative(twins.log_sh(golden["points"], None, *values, 8, log), golden[name]) < 1e-12


@pytest.mark.parametrize("log, name", [("cap", "irradiance_cap_eps3"), ("eigen", "irradiance_eigen_delta005")])
def test_irradiance_of_log_sh_is_the_golden_one(log, name, golden, device):
    assert relative(log_sh_irradiance(golden, log, device, threshold=0.125), golden[name]) < IRRADIANCE


def test_irradiance_of_the_product_of_spheres_is_the_golden_one(golden, device):
    _, normals = geometry(golden, device, has_normals=False)
    visibility = twins.multiplied_spheres(*(golden[name] for name in ("points", "sphere_centers", "sphere_radii")), 8)
    transfer = sh_transfer(wp.array(visibility[None], dtype=wp.float32, device=device), normals, order=8).numpy()[0]
    assert relative(np.pi * transfer @ golden["light_sh"], golden["irradiance_product"]) < IRRADIANCE


def test_unshadowed_irradiance_is_the_golden_one(golden, device):
    """Of the full light the golden value is, of which order 8 keeps all but 0.1% here."""
    _, normals = geometry(golden, device, has_normals=True)
    got = np.pi * sh_transfer(None, normals, order=8).numpy()[0] @ golden["light_sh"]
    assert relative(got, golden["irradiance_unshadowed"]) < 0.002


@pytest.mark.parametrize("count", [64, 128, 256])
def test_irradiance_of_directional_transmittance_is_the_golden_one(count, golden, device):
    assert (
        relative(directional_irradiance(golden, count, device), golden[f"irradiance_directional_{count}"]) < DIRECTIONAL
    )


@pytest.mark.parametrize("base, error", [("quadratic", 2e-3), ("linear", 1e-2), ("optimal_linear", 0.15)])
def test_the_default_threshold_of_each_base_stays_near_convergence(base, error, golden, device):
    got = log_sh_irradiance(golden, "eigen", device, base=base)
    assert relative(got, golden["irradiance_eigen_delta005"]) < error


def test_directional_beats_eigen_beats_cap_against_the_exact_occlusion(golden, device):
    """All with the band-limited light: what differs is visibility alone."""
    truth = golden["irradiance_truth_bandlimited_light"]
    directional_error = relative(directional_irradiance(golden, 128, device), truth)
    eigen, cap = (relative(log_sh_irradiance(golden, log, device), truth) for log in ("eigen", "cap"))
    assert directional_error < eigen < cap
    assert directional_error < 0.02


def test_fading_spheres_below_the_horizon_lowers_the_error_on_the_bunny(golden, device):
    truth = golden["irradiance_truth_bandlimited_light"][200:]
    kept, faded = (log_sh_irradiance(golden, "eigen", device, has_normals=has)[200:] for has in (False, True))
    assert relative(faded, truth) < relative(kept, truth)


def test_more_directions_come_nearer_to_the_exact_occlusion(golden, device):
    truth = golden["irradiance_truth_bandlimited_light"]
    errors = [relative(directional_irradiance(golden, count, device), truth) for count in (64, 128, 256)]
    assert errors[0] > errors[1] > errors[2]
