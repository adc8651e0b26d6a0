"""The solvers for joint problems against Clarabel, against each other, and against finite differences."""

import math

import pytest
import torch

from safety import qp_pdipm
from safety.kkt import kkt_residual, normalise_rows
from safety.qp import KKT_TOL, QPStatus, solve_qp
from safety.qp_joint import refutes
from tests.test_qp import BINDING, assert_finite, check_against_clarabel, tensor

torch.set_num_threads(1)
F64, F32 = torch.float64, torch.float32
BOTH = pytest.mark.parametrize("solver", ["active_set", "pdipm"])
DTYPES = pytest.mark.parametrize("dtype", [F64, F32])
SIZES = ((12, 14, 6), (6, 40, 16))
KINDS = ("random", "vertex", "duplicate", "zero", "infinite", "parallel", "weak", "scaled", "spread", "equality")


def problems(kind, B, m, n, *, spd=False, seed=0):
    """Random QPs (float64) with a feasible point, Q the identity unless spd."""
    gen = torch.Generator().manual_seed(1000 * m + 10 * n + seed)

    def normal(*shape):
        return torch.randn(*shape, generator=gen, dtype=F64)

    def uniform(*shape):
        return torch.rand(*shape, generator=gen, dtype=F64)

    M = normal(B, n, n)
    Q = M @ M.mT / n + 0.1 * torch.eye(n, dtype=F64) if spd else torch.eye(n, dtype=F64).repeat(B, 1, 1)
    G, x, p = normal(B, m, n), 0.2 * normal(B, n), 2 * normal(B, n)
    half = m // 2
    if kind == "parallel":
        G[:, half : 2 * half] = G[:, :half] + 1e-6 * normal(B, half, n)
    level = (G @ x[..., None])[..., 0]
    h = level + 0.5 * uniform(B, m)
    if kind == "vertex":
        h = level
    if kind == "duplicate":
        G[:, half : 2 * half], h[:, half : 2 * half] = 3 * G[:, :half], 3 * h[:, :half]
    if kind == "zero":
        G[:, ::3], h[:, ::3] = 0.0, uniform(B, len(h[0, ::3]))
        h[:, 0] = 0.0
    if kind == "infinite":
        h[:, ::2] = math.inf
    if kind == "parallel":
        h[:, half : 2 * half] = level[:, half : 2 * half] + (h[:, :half] - level[:, :half])
    if kind == "weak":  # x is the solution, the first rows pass through it, every other one with multiplier 0
        touching = n // 2
        lam = torch.zeros_like(h)
        lam[:, 0:touching:2] = 0.1 + uniform(B, len(h[0, 0:touching:2]))
        h[:, :touching] = level[:, :touching]
        p = -(Q @ x[..., None])[..., 0] - (G * lam[..., None]).sum(1)
    if kind == "scaled":
        size = 10 ** (8 * uniform(B, m) - 4)
        G, h = G * size[..., None], h * size
    if kind == "spread":
        G, h = G / G.norm(dim=-1, keepdim=True), 10 ** (8 * uniform(B, m) - 3)
    if kind == "equality":
        G[:, 1], h[:, 1] = -G[:, 0], -h[:, 0]
    return Q, p, G, h


def contradictory(B, m, n, gap, seed=0):
    """Problems of which n + 1 rows, and no fewer, contradict each other by `gap`; the others are far away."""
    Q, p, G, h = problems("random", B, m, n, seed=seed)
    weight = 0.2 + torch.rand(B, n, generator=torch.Generator().manual_seed(seed), dtype=F64)
    G[:, n] = -(weight[..., None] * G[:, :n]).sum(1)
    size = G[:, n].norm(dim=-1, keepdim=True)
    G[:, n] /= size
    h[:, n] = -(weight * h[:, :n]).sum(1) / size[:, 0] - gap
    h[:, n + 1 :] += 100.0
    return Q, p, G, h


def assert_optimal(Q, p, G, h, solution, tol):
    """The KKT residual over all rows, computed here from the outputs, is at most tol; and is the one reported."""
    unit, bound, size, _ = normalise_rows(G, h)
    lam = torch.where(unit.any(-1), solution.dual * size, 0.0)
    residual = kkt_residual(Q, p, unit, bound, solution.value, lam, torch.zeros_like(p[:, 0]), None)
    assert residual.max() <= tol
    assert solution.residual.max() <= tol


# ------------------------------------------------------------------------------------------ agreement with Clarabel


@BOTH
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spd", [False, True])
def test_agrees_with_clarabel(solver, kind, spd):
    for size in SIZES:
        Q, p, G, h = problems(kind, *size, spd=spd)
        solution = solve_qp(Q, p, G, h, solver=solver)
        assert_finite(solution)
        assert (solution.status == QPStatus.SOLVED).all()
        assert_optimal(Q, p, G, h, solution, 1e-11)
        # At a multiplier of 0 Clarabel's gap of 1e-12 leaves its solution uncertain by about 1e-6.
        counts = check_against_clarabel(Q, p, G, h, solution, None, 2e-5 if kind == "weak" else 1e-8)
        assert counts["infeasible"] == 0
        assert counts["solved"] >= size[0] // 4


@BOTH
@pytest.mark.parametrize("kind", ["random", "duplicate", "parallel", "scaled", "spread"])
def test_single_precision_data(solver, kind):
    data = [x.float() for x in problems(kind, *SIZES[0])]
    solution = solve_qp(*data, solver=solver)
    assert solution.value.dtype == solution.dual.dtype == solution.residual.dtype == F32
    assert (solution.status == QPStatus.SOLVED).all()
    assert check_against_clarabel(*data, solution, None, 1e-6)["solved"] >= 3


@BOTH
@pytest.mark.parametrize("size", [(8, 10, 4), (6, 40, 16)])
@pytest.mark.parametrize("gap", [1.0, 1e-3, 1e-6])
def test_contradictory_rows_are_reported(solver, size, gap):
    Q, p, G, h = contradictory(*size, gap)
    scale = 10 ** torch.linspace(-4, 4, size[1], dtype=F64)
    for factor in (torch.ones_like(scale), scale):
        solution = solve_qp(Q, p, G * factor[:, None], h * factor, solver=solver)
        assert (solution.status == QPStatus.INFEASIBLE).all()
        assert (solution.dual == 0).all()
        assert_finite(solution)


@BOTH
def test_rows_that_nearly_contradict_are_solved(solver):
    """The same rows with room instead of a gap: no proof of infeasibility may be found."""
    Q, p, G, h = contradictory(8, 10, 4, -1e-5)
    solution = solve_qp(Q, p, G, h, solver=solver)
    assert (solution.status == QPStatus.SOLVED).all()
    assert_optimal(Q, p, G, h, solution, 1e-9)


def test_a_refutation_needs_evidence():
    rows, weight, reach = tensor([[[1.0, 0], [-1, 0]]]), tensor([[1.0, 1.0]]), tensor([1.0])
    assert refutes(rows, tensor([[-1.0, 0.5]]), weight, reach)
    assert not refutes(rows, tensor([[-1.0, 1.0]]), weight, reach)
    assert not refutes(rows, tensor([[-1.0, 1.0 - 1e-10]]), weight, reach)
    # the rows do not cancel: a solution may lie far out
    assert not refutes(rows, tensor([[-1.0, 0.5]]), tensor([[1.0, 0.9]]), reach)
    assert not refutes(rows, tensor([[-1.0, 0.5]]), tensor([[0.0, 0.0]]), reach)
    assert refutes(rows, tensor([[-1.0, 0.5]]), tensor([[1.0, 0.99]]), reach)


# --------------------------------------------------------------------------------------------------- known answers


@BOTH
@DTYPES
@pytest.mark.parametrize(
    ("target", "G", "h", "value", "dual"),
    [
        *BINDING,
        # the most violated row, the first, is dropped again: its multiplier would be negative
        pytest.param([4, 3], [[0.6, 0.8], [1, 0]], [1.5, 0], [0, 1.875], [1.40625, 3.15625], id="two-steps"),
        pytest.param([3, 2.5], [[0.8, 0.6], [1, 0]], [2.5, 0], [0, 2.5], [0, 3], id="drop"),
    ],
)
def test_known_answers(solver, dtype, target, G, h, value, dual):
    target, G, h = (tensor(x, dtype=dtype) for x in (target, G, h))
    solution = solve_qp(torch.eye(2, dtype=dtype), -target, G, h, solver=solver)
    assert solution.status == QPStatus.SOLVED
    assert solution.residual <= 1e-12
    assert solution.iterations >= 1
    torch.testing.assert_close(solution.value, tensor(value, dtype=dtype), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(solution.dual, tensor(dual, dtype=dtype), rtol=1e-6, atol=1e-6)


@BOTH
@DTYPES
def test_nothing_violated_comes_back_bit_for_bit(solver, dtype):
    _, p, G, h = (x.to(dtype) for x in problems("random", 200, 12, 6))
    h = h.abs() + 0.3
    p = p * torch.logspace(-3, 1, 200, dtype=dtype)[:, None]
    free = ((G.double() @ -p.double()[..., None])[..., 0] <= h.double()).all(-1)
    assert 20 < free.sum() < 180
    p.requires_grad_()
    solution = solve_qp(torch.eye(6, dtype=dtype), p, G, h, solver=solver)
    assert torch.equal(solution.value[free], -p[free])
    for field in (solution.dual, solution.residual, solution.iterations, solution.status):
        assert (field[free] == 0).all()
    assert (solution.iterations[~free] > 0).all()
    solution.value.sum().backward()
    assert torch.equal(p.grad[free], -torch.ones_like(p)[free])


@BOTH
@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
@pytest.mark.parametrize("m", [0, 5])
def test_batch_shapes(solver, batch, m):
    p, G, h = torch.full((*batch, 5), -3.0), torch.eye(5)[:m], torch.ones(m)
    solution = solve_qp(2 * torch.eye(5), p, G, h, solver=solver)
    assert solution.value.shape == (*batch, 5)
    assert solution.dual.shape == (*batch, m)
    assert solution.status.shape == solution.residual.shape == solution.iterations.shape == batch
    assert solution.status.dtype == solution.iterations.dtype == torch.int64
    torch.testing.assert_close(solution.value, torch.full((*batch, 5), 1.0 if m else 1.5))


@BOTH
def test_radius_is_refused(solver):
    with pytest.raises(ValueError, match=f"{solver}.*no radius"):
        solve_qp(torch.eye(2), torch.zeros(2), torch.zeros(3, 2), torch.ones(3), radius=1.0, solver=solver)


# ----------------------------------------------------------------------------------------------------- robustness


@BOTH
@DTYPES
def test_non_finite_samples_are_set_aside(solver, dtype):
    Q, p, G, h = (x.to(dtype) for x in problems("random", 7, 10, 6))
    whole = solve_qp(Q, p, G, h, solver=solver)
    Q[1, 0, 0], p[2, 1], G[3, 4, 5], h[4, 0], h[5, 1] = math.nan, math.inf, math.nan, math.nan, -math.inf
    p.requires_grad_()
    solution = solve_qp(Q, p, G, h, solver=solver)
    assert solution.status.tolist() == [0, 1, 1, 1, 1, 1, 0]
    assert_finite(solution)
    assert (solution.value[1:6] == 0).all()
    torch.testing.assert_close(solution.value[[0, 6]], whole.value[[0, 6]])
    solution.value.sum().backward()
    assert (p.grad[1:6] == 0).all()


@BOTH
def test_extreme_numbers_give_no_nan(solver):
    Q, p, G, h = problems("random", 40, 10, 6)
    gen = torch.Generator().manual_seed(1)
    for low, high in ((-320, -290), (290, 308), (-300, 300), (-160, -140), (140, 160)):
        size = [10.0 ** (low + (high - low) * torch.rand(40, generator=gen, dtype=F64)) for _ in range(3)]
        data = (p * size[0][:, None], G * size[1][:, None, None], h * size[2][:, None])
        data = [torch.nan_to_num(x) for x in data]
        data[0].requires_grad_()
        solution = solve_qp(Q, *data, solver=solver)
        assert_finite(solution)
        assert (solution.residual[solution.status == QPStatus.SOLVED] <= KKT_TOL[F64]).all()
        assert torch.autograd.grad(solution.value.clamp(-1, 1).sum(), data[0])[0].isfinite().all()


@BOTH
def test_rows_of_extreme_size_count(solver):
    """Squares of 1e±200 leave float64; the rows are constraints all the same."""
    Q, p, G, h = problems("random", 20, 10, 6)
    plain = solve_qp(Q, p, G, h, solver=solver)
    size = 10.0 ** torch.linspace(-200, 200, 10, dtype=F64)
    scaled = solve_qp(Q, p, G * size[:, None], h * size, solver=solver)
    assert (scaled.status == QPStatus.SOLVED).all()
    torch.testing.assert_close(scaled.value, plain.value, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(scaled.dual * size, plain.dual, rtol=1e-8, atol=1e-8)


@BOTH
def test_indefinite_samples_are_not_solved(solver):
    Q = torch.stack([torch.eye(4, dtype=F64), -torch.eye(4, dtype=F64), torch.ones(4, 4, dtype=F64) * 2])
    solution = solve_qp(Q, -torch.ones(4, dtype=F64), torch.eye(4, dtype=F64), torch.zeros(4, dtype=F64), solver=solver)
    assert solution.status.tolist() == [0, 1, 1]
    assert_finite(solution)


def robot_rows(B, n_agents, seed):
    """Rows as the filter's: one per robot, one per pair, 16 faces per robot; some bounds are +inf."""
    gen = torch.Generator().manual_seed(seed)
    direction = torch.randn(B, n_agents, n_agents, 2, generator=gen, dtype=F64)
    eye = torch.eye(n_agents, dtype=F64)
    own = eye[..., None] * torch.einsum("biid->bid", direction)[:, :, None]
    i, j = torch.triu_indices(n_agents, n_agents, 1)
    pair = eye[i][..., None] * direction[:, i, j][:, :, None] - eye[j][..., None] * direction[:, i, j][:, :, None]
    angle = 2 * math.pi * torch.arange(16, dtype=F64) / 16
    faces = torch.stack([angle.cos(), angle.sin()], -1)
    face = torch.einsum("ij,fd->ifjd", eye, faces).flatten(0, 1).expand(B, -1, -1, -1)
    G = torch.cat([own, pair, face], 1).flatten(2)
    h = 3 * torch.rand(B, G.shape[1], generator=gen, dtype=F64).square() + 0.01
    h[:, :n_agents][torch.rand(B, n_agents, generator=gen) < 0.3] = math.inf
    h[:, -16 * n_agents :] = 1.0
    return torch.eye(2 * n_agents, dtype=F64), -1.2 * torch.randn(B, 2 * n_agents, generator=gen, dtype=F64), G, h


@BOTH
@pytest.mark.parametrize("n_agents", [3, 5])
def test_no_robot_problem_is_left_unsolved(solver, n_agents):
    data = robot_rows(400, n_agents, seed=n_agents)
    solution = solve_qp(*data, solver=solver)
    assert (solution.status == QPStatus.SOLVED).all()
    assert (solution.iterations > 0).sum() > 300
    assert_optimal(data[0].expand(400, -1, -1), *data[1:], solution, 1e-11)


def test_interior_point_survives_a_broken_factorisation(monkeypatch):
    """Near the solution the normal matrix may lose definiteness; the iterate before must be kept."""
    newton = qp_pdipm.newton

    def broken(L, rows, s, z, *rest):
        lost = ((s * z).amax(1) < 1e-8)[:, None]
        return tuple(torch.where(lost, math.nan, x) for x in newton(L, rows, s, z, *rest))

    monkeypatch.setattr(qp_pdipm, "newton", broken)
    solution = solve_qp(*problems("random", 20, 14, 6), solver="pdipm")
    assert (solution.status == QPStatus.SOLVED).all()


@BOTH
@pytest.mark.parametrize("kind", ["random", "zero", "scaled", "parallel"])
@pytest.mark.parametrize("spd", [False, True])
def test_batched_equals_looped(solver, kind, spd):
    Q, p, G, h = problems(kind, 12, 14, 6, spd=spd)
    p[:3] *= 1e-3  # some leave early
    batched = solve_qp(Q, p, G, h, solver=solver)
    for i in range(12):
        single = solve_qp(Q[i], p[i], G[i], h[i], solver=solver)
        assert single.status == batched.status[i]
        assert (single.value - batched.value[i]).norm() <= 1e-12 * batched.value[i].norm()


def test_both_agree_on_larger_problems():
    for kind in ("random", "spread"):
        Q, p, G, h = problems(kind, 4, 120, 48)
        one, other = (solve_qp(Q, p, G, h, solver=solver) for solver in ("active_set", "pdipm"))
        assert (one.status == QPStatus.SOLVED).all()
        assert (other.status == QPStatus.SOLVED).all()
        torch.testing.assert_close(one.value, other.value, rtol=1e-10, atol=1e-10)


# ------------------------------------------------------------------------------------------------------- gradients


def smooth_problems(count, m, n, *, spd):
    """Problems in which no multiplier and no slack is small, so that the active set stays under perturbation."""
    Q, p, G, h = problems("random", 300, m, n, spd=spd)
    solution = solve_qp(Q, p, G, h, solver="active_set")
    slack = h - (G @ solution.value[..., None])[..., 0]
    keep = (torch.maximum(solution.dual, slack) > 0.02).all(-1) & ((solution.dual > 0).sum(-1) >= 2)
    keep = keep.nonzero()[:count, 0]
    assert len(keep) == count
    return [x[keep].clone().requires_grad_() for x in (Q, p, G, h)]


@BOTH
@pytest.mark.parametrize("spd", [False, True])
def test_gradcheck(solver, spd):
    Q, p, G, h = smooth_problems(1, 6, 4, spd=spd)

    def value(Q, p, G, h):
        return solve_qp((Q + Q.mT) / 2, p, G, h, solver=solver).value

    assert torch.autograd.gradcheck(value, (Q, p, G, h), eps=1e-6, atol=1e-6, rtol=1e-5)


def gradients(inputs, weights, solver):
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    solution = solve_qp(*inputs, solver=solver)
    return torch.autograd.grad((solution.value * weights).sum(), inputs)


@BOTH
@DTYPES
def test_gradients_agree_with_qpth(solver, dtype):
    """Through a shared identity, the path of the filter, and through one matrix per sample."""
    for spd in (False, True):
        data = [x.detach().to(dtype) for x in smooth_problems(10, 9, 6, spd=spd)]
        data[0] = data[0] if spd else data[0][0]
        weights = torch.randn(10, 6, generator=torch.Generator().manual_seed(34)).to(dtype)
        tol = 1e-8 if dtype == F64 else 1e-4
        for a, b in zip(gradients(data, weights, solver), gradients(data, weights, "qpth"), strict=True):
            assert a.dtype == dtype
            torch.testing.assert_close(a, b, rtol=tol, atol=tol)


@BOTH
def test_gradient_of_the_target_alone(solver):
    data = [x.detach() for x in smooth_problems(10, 9, 6, spd=False)]
    weights = torch.randn(10, 6, generator=torch.Generator().manual_seed(35), dtype=F64)
    every = gradients(data, weights, solver)
    p = data[1].clone().requires_grad_()
    (solve_qp(data[0], p, *data[2:], solver=solver).value * weights).sum().backward()
    torch.testing.assert_close(p.grad, every[1])


@BOTH
@pytest.mark.parametrize("kind", ["vertex", "duplicate", "parallel", "weak", "equality"])
def test_gradients_are_finite_where_rows_are_redundant(solver, kind):
    data = problems(kind, *SIZES[0])
    for x in gradients(data, torch.ones_like(data[1]), solver):
        assert x.isfinite().all()
        assert x.any()


@BOTH
def test_no_gradient_without_a_solution(solver):
    Q, p, G, h = contradictory(4, 10, 4, 1.0)
    h[0, 4] += 10.0
    grads = gradients((Q, p, G, h), torch.ones_like(p), solver)
    assert all((x[1:] == 0).all() for x in grads)
    assert grads[1][0].any()


@pytest.mark.parametrize("solver", ["exact", "active_set", "pdipm", "qpth"])
def test_gradient_of_an_identity_matrix_where_nothing_binds(solver):
    Q, p = torch.eye(2, dtype=torch.float64, requires_grad=True), torch.tensor([1.0, 2.0], dtype=torch.float64)
    G, h = torch.tensor([[1.0, 0.0]], dtype=torch.float64), torch.tensor([5.0], dtype=torch.float64)
    solve_qp(Q, p, G, h, solver=solver).value.sum().backward()
    torch.testing.assert_close(Q.grad, torch.tensor([[1.0, 1.5], [1.5, 2.0]], dtype=torch.float64))
