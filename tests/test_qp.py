"""Known answers, agreement with Clarabel, and gradients of both QP solvers."""

import itertools
import math

import clarabel
import numpy as np
import pytest
import torch
from qpth.qp import QPFunction
from scipy import sparse

import safety.enumeration as enumeration
import safety.qp_exact as qp_exact
from safety.qp import KKT_TOL, QPStatus, project_halfspaces_ball, solve_qp

torch.set_num_threads(1)
F64, F32 = torch.float64, torch.float32
BOTH = pytest.mark.parametrize("solver", ["exact", "qpth"])
DTYPES = pytest.mark.parametrize("dtype", [F64, F32])
KINDS = ("slack", "vertex", "free", "scaled", "near", "equality")


def tensor(*values, dtype=F64):
    return torch.tensor(*values, dtype=dtype)


def project(target, G, h, radius=None, solver="exact"):
    Q = torch.eye(target.shape[-1], dtype=target.dtype)
    return solve_qp(Q, -target, G, h, radius=radius, solver=solver)


def problems(B, m, n, kind, seed, *, spd=False):
    """Random QPs (float64), feasible unless kind == "free"."""
    gen = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=gen, dtype=F64)

    G, p, x = normal(B, m, n), 2 * normal(B, n), 0.2 * normal(B, n)
    if kind == "near":
        G[:, 1] = G[:, 0] + 1e-4 * normal(B, n)
        G[:, 2] = -G[:, 0] + 1e-3 * normal(B, n)
    room = 0.5 * torch.rand(B, m, generator=gen, dtype=F64)
    h = (G @ x[..., None])[..., 0] + (0.0 if kind == "vertex" else room)
    if kind == "equality":
        G[:, 1], h[:, 1] = G[:, 0], h[:, 0]
        G[:, 2], h[:, 2] = -G[:, 0], -h[:, 0]
    if kind == "free":
        h = normal(B, m)
    if kind == "scaled":
        size = 10 ** (8 * torch.rand(B, m, generator=gen, dtype=F64) - 4)
        G, h = G * size[..., None], h * size
    M = normal(B, n, n)
    Q = M @ M.mT + 0.05 * torch.eye(n, dtype=F64) if spd else torch.eye(n, dtype=F64).repeat(B, 1, 1)
    return Q, p, G, h


def clarabel_solve(Q, p, G, h, radius=None):
    """Status and solution of one sample by Clarabel, the ball as a second-order cone."""
    Q, p, G, h = (x.double().numpy() for x in (Q, p, G, h))
    G, h, n = G[np.isfinite(h)], h[np.isfinite(h)], len(p)
    A, b, cones = [G], [h], [clarabel.NonnegativeConeT(len(h))]
    if radius is not None:
        A.append(np.vstack([np.zeros((1, n)), -np.eye(n)]))
        b.append(np.r_[radius, np.zeros(n)])
        cones.append(clarabel.SecondOrderConeT(n + 1))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    A, b = sparse.csc_matrix(np.vstack(A)), np.concatenate(b)
    solution = clarabel.DefaultSolver(sparse.csc_matrix(np.triu(Q)), p, A, b, cones, settings).solve()
    return str(solution.status), torch.tensor(solution.x, dtype=F64)


def check_against_clarabel(Q, p, G, h, solution, radius, tol):
    """Statuses agree and SOLVED values are within tol of Clarabel's, relative to the radius or to ‖u‖ + 0.01."""
    counts = {"solved": 0, "infeasible": 0}
    for i in range(len(p)):
        status, x = clarabel_solve(Q[i], p[i], G[i], h[i], radius)
        if status == "PrimalInfeasible":
            assert solution.status[i] == QPStatus.INFEASIBLE
            counts["infeasible"] += 1
        elif status == "Solved":
            assert solution.status[i] == QPStatus.SOLVED
            scale = radius or x.norm() + 0.01
            assert (solution.value[i].double() - x).abs().max() <= tol * scale
            counts["solved"] += 1
    return counts


def assert_finite(solution):
    assert solution.value.isfinite().all()
    assert solution.dual.isfinite().all()
    assert not solution.residual.isnan().any()
    assert (solution.dual >= 0).all()


# ---------------------------------------------------------------------------------------------- known answers


BINDING = [  # answers known by hand; the target violates a row
    pytest.param([2, 3], [[1, 0], [0, 1]], [1, 1], [1, 1], [1, 2], id="corner"),
    pytest.param([0, 0], [[1, 1]], [-2], [-1, -1], [1], id="origin-cut-off"),
    pytest.param([2, 1], [[100, 0], [0, 1e-3]], [100, 2e-3], [1, 1], [0.01, 0], id="scaled-rows"),
    pytest.param([2, 1], [[1, 0], [0, 1]], [1, math.inf], [1, 1], [1, 0], id="infinite-bound"),
    pytest.param([2, 1], [[1, 0], [0, 0]], [1, 0], [1, 1], [1, 0], id="idle-zero-row"),
    pytest.param([2, 1], [[1, 0], [-1, 0]], [1, -1], [1, 1], [1, 0], id="equality-pair"),
]


@BOTH
@DTYPES
@pytest.mark.parametrize(
    ("target", "G", "h", "value", "dual"),
    [
        *BINDING,
        pytest.param([0.3, 0.4], [[1, 0]], [1], [0.3, 0.4], [0], id="unconstrained"),
        pytest.param([2, 1], [[1, 0]], [1], [1, 1], [1], id="one-row"),
        pytest.param([5, -5], [[1, 0], [-1, 0], [0, 1], [0, -1]], [1] * 4, [1, -1], [4, 0, 0, 4], id="box"),
        pytest.param([1, 1], [[1, 0]], [1], [1, 1], [0], id="weakly-active"),
        pytest.param([0, 0], [[1, 0], [0, 1], [1, 1]], [0, 0, 0], [0, 0], [0, 0, 0], id="origin-vertex"),
        pytest.param([2, 3], [[0, 0]], [math.inf], [2, 3], [0], id="nothing-binds"),
    ],
)
def test_known_answers(solver, dtype, target, G, h, value, dual):
    solution = project(tensor(target, dtype=dtype), tensor(G, dtype=dtype), tensor(h, dtype=dtype), solver=solver)
    assert solution.value.dtype == solution.dual.dtype == dtype
    assert solution.status.shape == ()
    assert solution.status == QPStatus.SOLVED
    assert solution.residual <= KKT_TOL[dtype]
    torch.testing.assert_close(solution.value, tensor(value, dtype=dtype), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(solution.dual, tensor(dual, dtype=dtype), rtol=1e-5, atol=1e-6)


@DTYPES
@pytest.mark.parametrize("call", [solve_qp, project_halfspaces_ball])
@pytest.mark.parametrize(
    ("target", "G", "h", "value"),
    [
        pytest.param([3, 4], [[1, 0]], [9], [0.6, 0.8], id="ball-only"),
        pytest.param([3, 4], [[1, 0]], [0], [0, 1], id="ball-and-row"),
        pytest.param([0, 4], [[0, 1], [1, 0]], [0.5, -0.5], [-0.5, 0.5], id="two-rows-inside-ball"),
        pytest.param([3, 0], [[-1, 0]], [-1], [1, 0], id="row-touches-ball"),
        pytest.param([3, 4], [[-1, 0]], [-1], [1, 0], id="row-touches-ball-no-multipliers"),
        pytest.param([1e7, 1e7], [[1, 0]], [0.6], [0.6, 0.8], id="far-target"),
    ],
)
def test_known_answers_with_ball(dtype, call, target, G, h, value):
    target, G, h = (tensor(x, dtype=dtype) for x in (target, G, h))
    solution = project(target, G, h, 1.0) if call is solve_qp else project_halfspaces_ball(target, G, h, 1.0)
    assert solution.status == QPStatus.SOLVED
    torch.testing.assert_close(solution.value, tensor(value, dtype=dtype), rtol=1e-6, atol=1e-6)
    assert solution.value.norm() <= 1 + 1e-6


def test_line_meets_sphere_in_three_dimensions():
    """Two rows and the ball: the nearer of the two points where the line pierces the sphere."""
    G, h = tensor([[1.0, 0, 0], [0, 1.0, 0]]), tensor([0.6, 0.0])
    for z in (2.0, -2.0):
        solution = project_halfspaces_ball(tensor([3.0, 1.0, z]), G, h, 1.0)
        torch.testing.assert_close(solution.value, tensor([0.6, 0.0, math.copysign(0.8, z)]))


def test_ball_with_anisotropic_objective():
    """min ½uᵀQu + pᵀu on the unit ball, multiplier μ = 1 by construction: u = (0.6, 0.8), p = -(Q + I)u."""
    Q = torch.diag(tensor([1.0, 9.0]))
    solution = solve_qp(Q, tensor([-1.2, -8.0]), torch.zeros(0, 2, dtype=F64), torch.zeros(0, dtype=F64), radius=1.0)
    assert solution.status == QPStatus.SOLVED
    torch.testing.assert_close(solution.value, tensor([0.6, 0.8]))


@pytest.mark.parametrize("solver", ["exact", "active_set", "pdipm", "qpth"])
@DTYPES
@pytest.mark.parametrize(
    ("G", "h"),
    [
        pytest.param([[1, 0], [-1, 0]], [-1, -1], id="opposite-rows"),
        pytest.param([[1, 0], [0, 0]], [1, -1e-3], id="zero-row"),
        pytest.param([[1, 0], [-0.5, 0.8], [-0.5, -0.8]], [-1, -1, -1], id="triangle"),
        pytest.param([[1e-3, 0], [-1e3, 0]], [-1e-3, -1e3], id="badly-scaled"),
    ],
)
def test_infeasible_rows(solver, dtype, G, h):
    solution = project(tensor([0.3, 0.4], dtype=dtype), tensor(G, dtype=dtype), tensor(h, dtype=dtype), solver=solver)
    assert solution.status == QPStatus.INFEASIBLE
    assert_finite(solution)


@pytest.mark.parametrize("Q", [torch.eye(2), torch.tensor([[2.0, 0.5], [0.5, 1.0]])])
def test_row_outside_the_ball_is_infeasible(Q):
    solution = solve_qp(Q, torch.tensor([-3.0, 0.0]), torch.tensor([[-1.0, 0.0]]), torch.tensor([-2.0]), radius=1.0)
    assert solution.status == QPStatus.INFEASIBLE
    assert solution.value.norm() <= 1 + 1e-6
    assert_finite(solution)


@BOTH
@DTYPES
def test_non_finite_samples_are_set_aside(solver, dtype):
    target = tensor([[2, 1]] * 6, dtype=dtype)
    G, h = tensor([[[1, 0]]] * 6, dtype=dtype), tensor([[1]] * 6, dtype=dtype)
    target[1, 0], G[2, 0, 1], h[3, 0], h[4, 0] = math.nan, math.inf, math.nan, -math.inf
    target.requires_grad_()
    solution = project(target, G, h, solver=solver)
    assert solution.status.tolist() == [0, 1, 1, 1, 1, 0]
    assert torch.equal(solution.value[1:5], torch.zeros(4, 2, dtype=dtype))
    assert solution.residual[1:5].isinf().all()
    torch.testing.assert_close(solution.value[[0, 5]], tensor([[1, 1]] * 2, dtype=dtype))
    assert_finite(solution)
    solution.value.sum().backward()
    assert target.grad.isfinite().all()
    assert (target.grad[1:5] == 0).all()


@BOTH
def test_indefinite_or_overflowing_samples_are_not_solved(solver):
    Q = torch.stack([torch.eye(2, dtype=F64), -torch.eye(2, dtype=F64), tensor([[1.0, 2], [2, 1]])])
    G, h = tensor([[1.0, 0]]), tensor([1.0])
    solution = solve_qp(Q, tensor([-2.0, -1]), G, h, solver=solver)
    assert solution.status.tolist() == [0, 1, 1]
    assert_finite(solution)
    huge = solve_qp(torch.eye(2, dtype=F64), tensor([-1e300, 1e300]), 1e-300 * G, h, solver=solver)
    assert_finite(huge)
    tiny = solve_qp(torch.eye(2, dtype=F32), torch.tensor([-2.0, 0]), torch.tensor([[1e-40, 0]]), torch.tensor([1e-40]))
    assert_finite(tiny)


@BOTH
@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
@pytest.mark.parametrize("m", [0, 2])
def test_batch_shapes(solver, batch, m):
    p, G, h = torch.full((*batch, 2), -3.0), torch.eye(2)[:m], torch.ones(m)
    solution = solve_qp(2 * torch.eye(2), p, G, h, solver=solver)
    assert solution.value.shape == (*batch, 2)
    assert solution.dual.shape == (*batch, m)
    assert solution.status.shape == solution.residual.shape == solution.iterations.shape == batch
    assert solution.status.dtype == solution.iterations.dtype == torch.int64
    torch.testing.assert_close(solution.value, torch.full((*batch, 2), 1.0 if m else 1.5))


def test_one_dimension():
    solution = project_halfspaces_ball(tensor([[3.0], [-3], [0.2]]), tensor([[1.0]]), tensor([0.5]), 1.0)
    torch.testing.assert_close(solution.value, tensor([[0.5], [-1], [0.2]]))
    assert (solution.status == QPStatus.SOLVED).all()


def test_bad_arguments():
    Q, p, G, h = torch.eye(2), torch.zeros(2), torch.zeros(3, 2), torch.ones(3)
    with pytest.raises(ValueError, match=r"'ipopt'.*exact, qpth"):
        solve_qp(Q, p, G, h, solver="ipopt")
    with pytest.raises(ValueError, match="no radius"):
        solve_qp(Q, p, G, h, radius=1.0, solver="qpth")
    with pytest.raises(ValueError, match="n = 4"):
        solve_qp(torch.eye(4), torch.zeros(4), torch.zeros(3, 4), h)
    for radius in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="radius"):
            solve_qp(Q, p, G, h, radius=radius)
    with pytest.raises(ValueError, match="radius"):
        project_halfspaces_ball(p, G, h, None)
    bad = [
        (torch.zeros(2, 3), p, G, h),
        (Q, torch.zeros(3), G, h),
        (Q, p, torch.zeros(3, 3), h),
        (Q, p, G, torch.ones(2)),
        (Q, p, G.double(), h),
        (Q.half(), p.half(), G.half(), h.half()),
        (Q, torch.zeros(2, 2), torch.zeros(3, 3, 2), h),
    ]
    for arguments in bad:
        with pytest.raises(ValueError, match=r"must|broadcast"):
            solve_qp(*arguments)


# ------------------------------------------------------------------------------------------ agreement with Clarabel


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spd", [False, True])
@pytest.mark.parametrize("radius", [None, 1.0])
def test_exact_agrees_with_clarabel(n, kind, spd, radius):
    Q, p, G, h = problems(30, 7, n, kind, seed=10 * n + spd, spd=spd)
    solution = solve_qp(Q, p, G, h, radius=radius)
    assert_finite(solution)
    assert solution.residual[solution.status == QPStatus.SOLVED].max() < 1e-11
    # With a ball the error measured is Clarabel's: its gap of 1e-12 leaves the solution uncertain by about 1e-6.
    counts = check_against_clarabel(Q, p, G, h, solution, radius, 1e-8 if radius is None else 2e-6)
    assert counts["solved"] >= (2 if kind == "free" else 12)
    assert counts["infeasible"] >= (3 if kind == "free" else 0)


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("kind", ["slack", "free", "scaled", "near"])
@pytest.mark.parametrize("radius", [None, 1.0])
def test_exact_in_single_precision(n, kind, radius):
    data = [x.float() for x in problems(40, 7, n, kind, seed=n, spd=kind == "scaled")]
    solution = solve_qp(*data, radius=radius)
    assert solution.value.dtype == F32
    counts = check_against_clarabel(*data, solution, radius, 1e-6)
    assert counts["solved"] >= (2 if kind == "free" else 12)


@pytest.mark.parametrize("n", [2, 3, 6])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spd", [False, True])
def test_qpth_agrees_with_clarabel(n, kind, spd):
    Q, p, G, h = problems(30, 8, n, kind, seed=100 * n + spd, spd=spd)
    solution = solve_qp(Q, p, G, h, solver="qpth")
    assert_finite(solution)
    if kind == "equality":  # no interior: an honest INACCURATE is allowed, but only now and then
        assert (solution.status == QPStatus.INACCURATE).sum() <= 4
        keep = solution.status != QPStatus.INACCURATE
        Q, p, G, h = Q[keep], p[keep], G[keep], h[keep]
        solution = type(solution)(*(x[keep] for x in solution))
    counts = check_against_clarabel(Q, p, G, h, solution, None, 1e-8)
    assert counts["solved"] >= (2 if kind == "free" else 12)
    assert counts["infeasible"] >= (3 if kind == "free" and n < 6 else 0)


def cbf_problems(B, m, n, seed):
    """Barrier-like rows: unit gradients, bounds log-uniform over 1e-3..1e5."""
    gen = torch.Generator().manual_seed(seed)
    G = torch.nn.functional.normalize(torch.randn(B, m, n, generator=gen, dtype=F64), dim=-1)
    h = 10 ** (8 * torch.rand(B, m, generator=gen, dtype=F64) - 3)
    Q, p = torch.eye(n, dtype=F64).repeat(B, 1, 1), torch.randn(B, n, generator=gen, dtype=F64)
    return Q, p, G, h


@pytest.mark.parametrize(("n", "m"), [(2, 4), (2, 17), (3, 12), (6, 18)])
def test_qpth_is_guarded_against_spread_bounds(n, m):
    Q, p, G, h = cbf_problems(100, m, n, seed=n)
    for dtype, tol in ((F64, 1e-8), (F32, 1e-6)):
        data = [x.to(dtype) for x in (Q, p, G, h)]
        solution = solve_qp(*data, solver="qpth")
        assert (solution.status == QPStatus.SOLVED).all()
        if n <= 3:
            torch.testing.assert_close(solution.value, solve_qp(*data).value, rtol=tol, atol=tol)
        assert check_against_clarabel(*data, solution, None, tol)["solved"] >= 40


def test_stock_qpth_is_wrong_on_spread_bounds():
    """Otherwise the guard would have nothing to do: in single precision stock qpth fails silently on 20-30 %."""
    data = [x.float() for x in cbf_problems(100, 18, 6, seed=1)]
    none = torch.empty(0)
    stock = QPFunction(verbose=-1)(*data, none, none)
    guarded = solve_qp(*data, solver="qpth")
    assert (guarded.status == QPStatus.SOLVED).all()
    right, stock_wrong = 0, 0
    for i in range(100):
        status, x = clarabel_solve(*(d[i] for d in data))
        if status == "Solved":
            right += int((guarded.value[i] - x).norm() <= 1e-6 * (1 + x.norm()))
            stock_wrong += int((stock[i] - x).norm() > 1e-2)
        else:
            right += 1  # Clarabel gave up, nothing to compare with
    assert right == 100
    assert stock_wrong >= 10


def test_qpth_never_prints(capfd):
    solve_qp(*problems(30, 8, 2, "free", seed=1), solver="qpth")
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


@BOTH
@pytest.mark.parametrize("angle", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("dtype", [F64, F32])
def test_thin_wedge(solver, angle, dtype):
    """Two nearly opposite rows whose planes meet at the tip of a thin wedge; the tip is nearest to the target."""
    G = tensor([[0.0, 1.0], [math.sin(angle), -1.0]], dtype=dtype)
    tip = tensor([0.25, 0.5], dtype=dtype)
    h = torch.stack([tip[1], G[1, 0] * tip[0] - tip[1]])
    # The tip of the data as rounded, in double precision:
    y = h[0].double()
    x = (h[1].double() + y) / G[1, 0].double()
    solution = project(tensor([0.75, 0.5], dtype=dtype), G, h, solver=solver)
    assert_finite(solution)
    if solver == "exact":
        assert solution.status == QPStatus.SOLVED
    if solution.status == QPStatus.SOLVED:
        error = (solution.value.double() - torch.stack([x, y])).abs().max()
        assert error <= (1e-4 if dtype == F32 else 1e-15 / angle * 10)


# ------------------------------------------------------------------------------------- fast path, batching, scaling


@DTYPES
def test_feasible_targets_come_back_bit_for_bit(dtype):
    _, _, G, h = (x.to(dtype) for x in problems(500, 6, 2, "slack", seed=5))
    target = 0.6 * torch.randn(500, 2, generator=torch.Generator().manual_seed(6)).to(dtype)
    h = h.abs() + 0.3
    target[:4] = 0.0
    target[0] = -0.0
    inside = ((G.double() @ target.double()[..., None])[..., 0] <= h.double()).all(-1) & (
        target.double().norm(dim=-1) <= 1
    )
    assert 50 < inside.sum() < 450
    target.requires_grad_()
    solution = project_halfspaces_ball(target, G, h, 1.0)
    assert torch.equal(solution.value[inside], target[inside])
    assert torch.equal(solution.value[0].signbit(), target[0].signbit())
    for field in (solution.dual, solution.residual, solution.iterations, solution.status):
        assert (field[inside] == 0).all()
    assert (solution.iterations[~inside] > 0).all()
    weights = torch.randn(500, 2, generator=torch.Generator().manual_seed(7)).to(dtype)
    (solution.value * weights).sum().backward()
    assert torch.equal(target.grad[inside], weights[inside])


def test_result_is_inside_the_ball_and_the_rows():
    gen = torch.Generator().manual_seed(8)
    target, G = 3 * torch.randn(4000, 3, generator=gen), torch.randn(4000, 6, 3, generator=gen)
    h = torch.rand(4000, 6, generator=gen) - 0.1
    solution = project_halfspaces_ball(target, G, h, 0.7)
    assert (solution.status != QPStatus.INACCURATE).all()
    assert solution.value.norm(dim=-1).max() <= 0.7 * (1 + 1e-6)
    solved = solution.status == QPStatus.SOLVED
    excess = (G @ solution.value[..., None])[..., 0] - h
    assert excess[solved].max() <= 1e-6 * G.norm(dim=-1).max()


def test_chunks_change_nothing(monkeypatch):
    _, p, G, h = problems(100, 6, 3, "slack", seed=9)
    whole = project_halfspaces_ball(-p, G, h, 1.0)
    monkeypatch.setattr(qp_exact, "CHUNK_BYTES", 1)
    monkeypatch.setattr(enumeration, "CHUNK_BYTES", 1)
    for a, b in zip(whole, project_halfspaces_ball(-p, G, h, 1.0), strict=True):
        torch.testing.assert_close(a, b)


@BOTH
def test_batched_equals_looped(solver):
    Q, p, G, h = problems(20, 5, 3, "slack", seed=11, spd=True)
    batched = solve_qp(Q, p, G, h, solver=solver)
    for i in range(20):
        single = solve_qp(Q[i], p[i], G[i], h[i], solver=solver)
        assert single.status == batched.status[i]
        torch.testing.assert_close(single.value, batched.value[i], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(single.dual, batched.dual[i], rtol=1e-7, atol=1e-7)


@BOTH
def test_row_scale_does_not_matter(solver):
    Q, p, G, h = problems(40, 6, 2, "slack", seed=12)
    size = 10 ** torch.linspace(-6, 6, 6, dtype=F64)
    plain = solve_qp(Q, p, G, h, solver=solver)
    scaled = solve_qp(Q, p, G * size[:, None], h * size, solver=solver)
    torch.testing.assert_close(plain.value, scaled.value, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(plain.dual, scaled.dual * size, rtol=1e-7, atol=1e-7)
    assert torch.equal(plain.status, scaled.status)


# ------------------------------------------------------------------------------------------------------- gradients


def smooth_problems(count, m, n, *, spd, radius, seed):
    """Problems in which no multiplier and no slack is small, so that the active set stays under perturbation."""
    Q, p, G, h = problems(200, m, n, "slack", seed=seed, spd=spd)
    solution = solve_qp(Q, p, G, h, radius=radius)
    slack = h - (G @ solution.value[..., None])[..., 0]
    clear = (torch.maximum(solution.dual, slack) > 0.05).all(-1) & (solution.status == QPStatus.SOLVED)
    if radius is not None:
        room = radius - solution.value.norm(dim=-1)
        active = (solution.dual * (solution.dual > 0)).unsqueeze(-1) * G
        push = ((Q @ solution.value[..., None])[..., 0] + p + active.sum(1)).norm(dim=-1)
        clear &= (room > 0.05) | (push > 0.05)
    keep = clear.nonzero()[:count, 0]
    assert len(keep) == count
    return [x[keep].clone().requires_grad_() for x in (Q, p, G, h)]


@pytest.mark.parametrize(
    ("solver", "n", "spd", "radius"),
    [
        *itertools.product(["exact"], [2, 3], [False, True], [None, 0.8]),
        ("qpth", 2, False, None),
        ("qpth", 3, True, None),
    ],
)
def test_gradcheck(solver, n, spd, radius):
    Q, p, G, h = smooth_problems(2, 3, n, spd=spd, radius=radius, seed=20 + n)

    def value(Q, p, G, h):
        return solve_qp((Q + Q.mT) / 2, p, G, h, radius=radius, solver=solver).value

    if radius is not None:
        assert (value(Q, p, G, h).norm(dim=-1) > radius - 1e-9).any()
    assert torch.autograd.gradcheck(value, (Q, p, G, h), eps=1e-6, atol=1e-5, rtol=1e-4)


def test_gradcheck_projection():
    _, p, G, h = smooth_problems(3, 4, 3, spd=False, radius=0.8, seed=31)
    assert torch.autograd.gradcheck(lambda p, G, h: project_halfspaces_ball(-p, G, h, 0.8).value, (p, G, h), atol=1e-5)


def gradients(inputs, weights, **kwargs):
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    solution = solve_qp(*inputs, **kwargs)
    return torch.autograd.grad((solution.value * weights).sum(), inputs)


@DTYPES
def test_gradients_of_both_solvers_agree(dtype):
    data = [x.detach().to(dtype) for x in smooth_problems(20, 5, 3, spd=True, radius=None, seed=33)]
    weights = torch.randn(20, 3, generator=torch.Generator().manual_seed(34)).to(dtype)
    tol = 1e-7 if dtype == F64 else 1e-4
    for a, b in zip(gradients(data, weights), gradients(data, weights, solver="qpth"), strict=True):
        assert a.dtype == dtype
        torch.testing.assert_close(a, b, rtol=tol, atol=tol)


@BOTH
def test_gradients_of_unbatched_inputs_are_summed(solver):
    Q, p, G, h = (x.detach() for x in smooth_problems(6, 4, 2, spd=True, radius=None, seed=35))
    G, h, Q = G[0], h[0], Q[0]
    weights = torch.randn(6, 2, generator=torch.Generator().manual_seed(36), dtype=F64)
    shared = gradients((Q, p, G, h), weights, solver=solver)
    full = (Q.expand(6, 2, 2), p, G.expand(6, 4, 2), h.expand(6, 4))
    apart = gradients(full, weights, solver=solver)
    for k, (one, many) in enumerate(zip(shared, apart, strict=True)):
        torch.testing.assert_close(one, many if k == 1 else many.sum(0))


@BOTH
@pytest.mark.parametrize("G", [[[1, 0], [1, 0]], [[1, 0], [-1, 0]], [[1, 0], [0, 1], [1, 1]], [[1, 0], [1, 1e-9]]])
def test_redundant_active_rows_have_finite_gradients(solver, G):
    G = tensor(G).requires_grad_()
    point = tensor([1.0, 1.0])
    h = (G.detach() @ point).requires_grad_()
    target = tensor([3.0, 2.0]).requires_grad_()
    solution = project(target, G, h, solver=solver)
    assert solution.status == QPStatus.SOLVED
    solution.value[0].backward()
    for x in (target, G, h):
        assert x.grad.isfinite().all()
    torch.testing.assert_close(target.grad, torch.zeros(2, dtype=F64), atol=1e-6, rtol=0)


@BOTH
def test_weakly_active_row_counts_as_inactive(solver):
    target = tensor([1.0, 0.3]).requires_grad_()
    project(target, tensor([[1.0, 0.0]]), tensor([1.0]), solver=solver).value.sum().backward()
    torch.testing.assert_close(target.grad, torch.ones(2, dtype=F64))


@BOTH
def test_no_gradient_without_a_solution(solver):
    target = torch.ones(2, 2, dtype=F64, requires_grad=True)
    h = tensor([[-1.0, -1.0], [0.5, 1.0]]).requires_grad_()
    solution = project(target, tensor([[1.0, 0], [-1, 0]]), h, solver=solver)
    assert solution.status.tolist() == [QPStatus.INFEASIBLE, QPStatus.SOLVED]
    solution.value.sum().backward()
    torch.testing.assert_close(target.grad, tensor([[0.0, 0], [0, 1]]))
    torch.testing.assert_close(h.grad, tensor([[0.0, 0], [1, 0]]))
