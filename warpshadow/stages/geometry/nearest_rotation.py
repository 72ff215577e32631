"""The rotation that is nearest to a matrix: how nine free numbers become one.

It is a file, and so a module of Warp's, of its own: the singular value decomposition takes seconds to compile.
"""

import warp as wp

from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty


@wp.kernel(enable_backward=False)
def _nearest_rotations(
    # in
    matrices: wp.array2d(dtype=wp.mat33),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
    left_factors: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation, U diag(1, 1, det UVᵀ) Vᵀ of the singular value decomposition M = U Σ Vᵀ."""
    batch, body = wp.tid()
    m = wp.mat33d(matrices[batch, body])
    u, _s, v = wp.svd3(m / wp.sqrt(wp.ddot(m, m)))
    one = wp.float64(1.0)
    sign_matrix = wp.diag(wp.vec3d(one, one, wp.sign(wp.determinant(u) * wp.determinant(v))))
    rotation = wp.mat33(u * sign_matrix * wp.transpose(v))
    rotations[batch, body] = rotation
    left_factors[batch, body] = rotation


@wp.kernel(enable_backward=False)
def _nearest_rotations_adjoint(
    # in
    matrices: wp.array2d(dtype=wp.mat33),
    rotations: wp.array2d(dtype=wp.mat33),
    adj_rotations: wp.array2d(dtype=wp.mat33),
    # out
    adj_matrices: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation.

    With M = R S, S symmetric, dR = R [ω]ₓ, where (tr S I − S) ω is the axial vector of RᵀdM − dMᵀR. (The adjoint of
    Warp's svd3 divides by differences of singular values, which are equal where M is a rotation.)
    """
    batch, body = wp.tid()
    r = wp.mat33d(rotations[batch, body])
    s = wp.transpose(r) * wp.mat33d(matrices[batch, body])
    g = wp.transpose(r) * wp.mat33d(adj_rotations[batch, body])
    axial = wp.vec3d(g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1])
    rotation_vector = wp.inverse(wp.trace(s) * wp.identity(n=3, dtype=wp.float64) - s) * axial
    adj_matrices[batch, body] = adj_matrices[batch, body] + wp.mat33(r * wp.skew(rotation_vector))


def nearest_rotations(matrices: wp.array) -> wp.array:
    """Find the rotations R that minimize |R − M|.

    Args:
        matrices: M, mat33 of shape [batch, body], each near to one rotation alone.
    Returns:
        Rotations, mat33 of shape [batch, body].
    Differentiable: matrices.
    """
    # the caller may overwrite the gradients that it gets
    left_factors = empty(matrices.shape, dtype=wp.mat33, device=matrices.device)

    def forward(rotations: wp.array) -> None:
        launch(_nearest_rotations, matrices.shape, inputs=[matrices], outputs=[rotations, left_factors])

    def adjoint(adj_rotations: wp.array) -> None:
        inputs = [matrices, left_factors, adj_rotations]
        launch(_nearest_rotations_adjoint, matrices.shape, inputs=inputs, outputs=[matrices.grad])

    return differentiable(forward, adjoint, result=wp.empty_like(left_factors), variables=[matrices])
