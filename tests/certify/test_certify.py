"""The certified map: cells and their cones, the bounds, whether the cells tell the truth, and the checker."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from oracles import segment_mesh_distance
from places import REAL_CT, TESTS
from refusals import refused
from scipy.optimize import nnls

from puncture_twin.meshes import folder
from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin import Skin, skin_from_mesh, skin_paths
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.entry import Directions, angles, entry_frame, outward
from puncture_twin.planning.case.tables import EntryAxes
from puncture_twin.planning.certify.cells import SQUARE_DEGREES, Cells, Lists, nearest_cell, split, zones
from puncture_twin.planning.certify.certificate import read_certificate, write_certificate
from puncture_twin.planning.certify.checker import _apart, _Cell, verify
from puncture_twin.planning.certify.near_organs import Organs, organ_facts
from puncture_twin.planning.certify.skin_cones import skin_bounds, skin_surface
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import BOX_FACES, TriangleMesh
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK

REAL = TESTS / "real"

CASES = {"abdomen": ("abdomen", 3.0), "carton": ("carton/case_m.toml", 3.0)}
"""Case, and the size in degrees to which the tests certify it."""
QUARTER = {"beta": (np.pi, 1.5 * np.pi)}
"""Of the carton's cap: cells of every verdict, too close and too long among the rejected, a third of the work."""
unit_interval = st.floats(0, 1)


def angle_between(a, b):
    return 2 * np.arcsin(np.minimum(0.5 * np.linalg.norm(a - b, axis=-1), 1.0))


@pytest.fixture(scope="module", params=sorted(CASES))
def certified(request):
    name, size = CASES[request.param]
    context = prepare(folder() / name, arm=False)
    return context, certify(context.case, context.anatomy, size=np.radians(size))


@pytest.fixture(scope="module")
def carton():
    context = prepare(folder() / "carton" / "case_m.toml", arm=False)
    return context, certify(context.case, context.anatomy, size=np.radians(6), **QUARTER)


def _agreed(context, anatomy, found, theta, beta):
    """The map's letters of directions, after FCL has contradicted none."""
    engine = FclEngine([structure.mesh for structure in anatomy.checked])
    directions = Directions(theta, beta, outward(theta, beta) @ context.case.T_ct_entry[:3, :3].T)
    rated = organ_candidates(context.case, anatomy, engine, directions)
    letters = found.at(theta, beta)
    assert rated.safe[letters == "S"].all()
    assert not rated.safe[letters == "R"].any()
    return letters


def _thrown_into(cells, rows, rng):
    return tuple(rng.uniform(ranges[rows, 0], ranges[rows, 1]) for ranges in (cells.theta, cells.beta))


# cells


@given(st.lists(unit_interval, min_size=4, max_size=4), st.lists(unit_interval, min_size=2, max_size=2))
@settings(max_examples=300)
def test_a_cone_encloses_its_cell(corners, inside):
    theta = np.sort(np.pi * np.array(corners[:2]))
    beta = 2 * np.pi * corners[2] + np.array([0, np.pi * corners[3]])
    cell = Cells(theta[None], beta[None])
    direction = outward(theta[0] + inside[0] * np.ptp(theta), beta[0] + inside[1] * np.ptp(beta))
    assert angle_between(cell.centres()[0], direction) <= cell.radius()[0]


def test_cells_have_the_spheres_area_and_no_cone_where_too_wide():
    assert Cells(np.array([[0, 1.0]]), np.array([[0, 3.2]])).radius()[0] == np.pi
    sphere = Cells(np.array([[0, np.pi]]), np.array([[0, 2 * np.pi]]))
    assert sphere.solid_angle()[0] * SQUARE_DEGREES == pytest.approx(41252.96, abs=0.01)


@pytest.mark.parametrize("theta", [(0, np.pi), (0, np.pi / 2), (0.3, 0.31), (3.0, np.pi)])
def test_halves_and_quarters_tile_their_cell(theta, rng):
    cells = Cells(np.array([theta], float), np.array([[0, 2 * np.pi]]))
    area = cells.solid_angle()[0]
    for _ in range(6):
        cells, _ = split(cells, cells.splits(cells.radius()))
    assert cells.solid_angle().sum() == pytest.approx(area, rel=1e-12)
    t, b = rng.uniform(*theta, 500), rng.uniform(0, 2 * np.pi, 500)
    within = (cells.theta[:, :1] < t) & (t < cells.theta[:, 1:]) & (cells.beta[:, :1] < b) & (b < cells.beta[:, 1:])
    np.testing.assert_array_equal(within.sum(axis=0), 1)


def test_the_nearest_cell_is_as_near_as_sampling_says(rng):
    """Against a dense sample of the cell's directions: never farther, and nearer by less than the sample's spacing."""
    for _ in range(40):
        theta, beta = np.sort(rng.uniform(0, np.pi, 2)), rng.uniform(0, 6) + np.array([0, rng.uniform(0, 5)])
        at = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        found = nearest_cell(np.array([at[0]]), np.array([at[1]]), Cells(theta[None], beta[None]))[0]
        grid = np.meshgrid(np.linspace(*theta, 150), np.linspace(*beta, 200))
        sampled = angle_between(outward(*grid), outward(*at)).min()
        assert sampled - 0.04 <= found <= sampled + 1e-9


# bounds


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=300)
def test_a_cell_is_a_sum_of_its_corners_and_a_bulge(seed):
    rng = np.random.default_rng(seed)
    cell = _random_cell(rng, 10 ** rng.uniform(-3, 0.4))
    shape = cell.cones(np.eye(3))
    v = outward(*_thrown_into(cell, np.zeros(1, int), rng))[0]
    weights, rest = nnls(shape.corners[0].T, v)
    assert rest <= shape.bulge[0] + 1e-12
    assert weights.sum() >= 1 - shape.bulge[0]
    assert angle_between(shape.centres[0], v) <= shape.radius[0]


def _random_cell(rng, size):
    theta, beta = rng.uniform(0, np.pi), rng.uniform(0, 6)
    wide = min(size / max(np.sin(theta), 0.1), np.pi)
    return Cells(np.array([[theta, min(theta + size, np.pi)]]), np.array([[beta, beta + wide]]))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_what_is_said_of_a_cell_holds_for_its_axes(seed):
    """Random triangles and a random cell: brute force on axes all over it, also at its corners, never contradicts.

    The checker's planes are held against the same axes.
    """
    rng = np.random.default_rng(seed)
    corners = rng.normal(0, 40, (6, 1, 3)) + rng.normal(0, 10 ** rng.uniform(-1, 1.5), (6, 3, 3))
    cell, limit, length = _random_cell(rng, 10 ** rng.uniform(-3, -0.5)), rng.uniform(0.1, 8), 90.0
    shape, group, first = cell.cones(np.eye(3)), np.zeros(6, np.int64), np.zeros(1, np.int64)
    organs = Organs(corners.reshape(6, 9), group, np.array([limit]), zones(corners, limit))
    shortest = length * rng.choice([1.0, rng.uniform(0.3, 1.0)])
    witness, lengths = np.array([rng.integers(-1, 6)]), np.array([[shortest, length]])
    found = organ_facts(organs, Lists.one(np.arange(6)), first, witness, shape, lengths, wide=9.0, pad=0.0)
    plain = _apart(corners, np.full(6, limit), _Cell(tuple(cell.theta[0]), tuple(cell.beta[0]), np.eye(3)), length)
    at = np.concatenate([rng.uniform(size=(6, 2)), [[0, 0], [0, 1], [1, 0], [1, 1], [0, 0.5], [1, 0.5]]])
    for v in (cell.at(*parts)[0] for parts in at):
        each = np.array([segment_mesh_distance(np.zeros(3), length * v, _triangle(t)) for t in corners])
        early = segment_mesh_distance(np.zeros(3), shortest * v, _triangle(corners[found.witness[0]]))
        assert (each[plain] >= limit - 1e-9).all()
        if found.rejected[0]:
            assert each[found.witness[0]] - 1e-9 <= early <= found.largest[0] + 1e-9 < limit + 1e-9
        else:
            clear = np.setdiff1d(np.arange(6), found.near.items)
            assert (each[clear] >= limit - 1e-9).all()


def _triangle(corners):
    return TriangleMesh(corners, [[0, 1, 2]])


def test_bounds_are_not_idle(rng):
    decided = 0
    for _ in range(200):
        cell, length = _random_cell(rng, 0.005), 90.0
        shape, first = cell.cones(np.eye(3)), np.zeros(1, np.int64)
        corners = 60 * shape.centres[0] + rng.normal(0, 1, 3) + rng.normal(0, 0.3, (1, 3, 3))
        organs = Organs(corners.reshape(1, 9), first, np.ones(1), zones(corners, 1.0))
        lengths = np.full((1, 2), length)
        found = organ_facts(organs, Lists.one(first), first, first - 1, shape, lengths, wide=9.0, pad=0.0)
        decided += bool(found.rejected[0]) or not len(found.near.items)
    assert decided > 150


def _turned(u, rho, rng):
    aside = np.cross(u, rng.normal(size=3))
    by = rho * rng.choice([rng.uniform(), 1.0])
    return np.cos(by) * u + np.sin(by) * aside / np.linalg.norm(aside)


@pytest.mark.parametrize("shape", ["ball", "box", "bumpy"])
def test_the_skin_bounds_hold(shape, ball, box, rng):
    """Count, depth and angle of every ray of a cone stay within the cone's bounds, on smooth, flat and folded skins."""
    meshes = {
        "ball": ball(60, (5, 8, -3)),
        "box": box((120, 90, 70), (4, 6, 9)),
        "bumpy": _bumpy(ball(60, (3, 2, 1), 4)),
    }
    mesh = meshes[shape]
    skin = skin_from_mesh(mesh)
    surface = skin_surface(skin, np.zeros(3))
    everything = Lists.one(np.arange(len(mesh.faces)))
    length, longest = 75.0, 70.0
    proven = 0
    for _ in range(40):
        u, rho = outward(rng.uniform(0, np.pi), rng.uniform(0, 6.3)), 10 ** rng.uniform(-3, -0.8)
        cone = u[None], np.array([rho])
        found = skin_bounds(surface, everything, *cone, _turned(u, rho, rng)[None], length=length, longest=longest)
        rays = np.array([_turned(u, rho, rng) for _ in range(60)])
        paths = skin_paths(skin, np.zeros(3), rays, length)
        hit = paths.path_length <= longest
        assert (paths.path_length[hit] >= found.least_skin[0] - 1e-9).all()
        assert (paths.skin_angle[hit] >= found.least_angle[0] - 1e-9).all()
        assert (paths.skin_angle[hit] <= found.largest_angle[0] + 1e-9).all()
        if found.count[0] >= 0:
            proven += 1
            within = paths.path_length <= length
            assert (within == (found.count[0] >= 1)).all()
            assert (~np.isnan(paths.reentry_depth) == (found.count[0] >= 2)).all()
            assert (paths.path_length[within] <= found.farthest[0] + 1e-9).all()
    assert proven > 8


def _bumpy(mesh):
    swing = 1 + 0.25 * np.sin(mesh.vertices / 8).prod(axis=1, keepdims=True)
    stretched = mesh.vertices * swing
    stretched[:, 0] += 0.02 * stretched[:, 1] ** 2
    return TriangleMesh(stretched, mesh.faces)


# the certified map


def test_the_cap_is_decided_without_contradiction_and_proven_cell_by_cell(certified, rng):
    context, found = certified
    rows = rng.integers(0, len(found.leaves), 600)
    theta, beta = _thrown_into(found.leaves, rows, rng)
    theta = np.concatenate([theta, np.arccos(rng.uniform(0, 1, 400))])
    beta = np.concatenate([beta, rng.uniform(0, 2 * np.pi, 400)])
    letters = _agreed(context, context.anatomy, found, theta, beta)
    assert min((letters == "S").sum(), (letters == "R").sum()) > 120
    assert sum(found.areas.values()) == pytest.approx(20626.48, rel=1e-6)
    assert (2 * found.leaves.radius()[found.verdict == "U"] <= found.size).all()
    assert found.fraction("U") < 0.15
    assert found.fraction("S") > 0.15
    assert found.fraction("R") > 0.15
    checked = verify(found, context.case, context.anatomy)
    assert (checked.safe, checked.rejected, checked.undecided) == tuple(
        int((found.verdict == letter).sum()) for letter in "SRU"
    )


def test_the_safe_cone_is_safe_and_none_where_nothing_is_proven(certified, rng):
    context, found = certified
    rows = rng.choice(np.flatnonzero(found.verdict == "S"), 30, replace=False)
    R = context.case.T_ct_entry[:3, :3]
    centres = found.leaves.take(rows).centres() @ R.T
    cones = found.safe_cone(centres)
    assert (cones > 0).all()
    around = np.concatenate(
        [[_turned(u, 0.999 * cone, rng) for _ in range(20)] for u, cone in zip(centres, cones, strict=True)]
    )
    theta, beta = angles(around @ R)
    assert (_agreed(context, context.anatomy, found, theta, beta) == "S").all()
    rows = np.flatnonzero(found.verdict != "S")[:200]
    assert (found.safe_cone(found.leaves.take(rows).centres() @ R.T) == 0).all()
    assert found.safe_cone(-R[:, 2][None])[0] == 0
    assert (found.at(np.array([3.0]), np.array([1.0])) == "")[0]


def test_fewer_queries_than_the_dense_grid(carton):
    """At half a degree distances are asked for less than a tenth of the directions of a grid of that spacing."""
    context, _ = carton
    found = certify(context.case, context.anatomy, size=np.radians(0.5))
    assert found.queries < 0.1 * 720 * 181
    assert found.fraction("U") < 0.01


def test_a_file_gives_the_same_certificate(carton, tmp_path):
    _, found = carton
    write_certificate(found, tmp_path / "c.json")
    read = read_certificate(tmp_path / "c.json")
    for name in ("theta", "beta"):
        np.testing.assert_array_equal(getattr(read.leaves, name), getattr(found.leaves, name))
    for name in ("verdict", "reason", "structure", "triangle"):
        np.testing.assert_array_equal(getattr(read, name), getattr(found, name))
    np.testing.assert_allclose(read.bound, found.bound, atol=1e-6)
    assert read.summary() == found.summary()


def _swap(document, old, new):
    for depth, level in enumerate(document["tree"]):
        if old in level:
            document["tree"][depth] = level.replace(old, new, 1)
            return


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: _swap(d, "R", "S"), "certificate_damaged"),
        (lambda d: _swap(d, "S", ""), "certificate_damaged"),
        (lambda d: d["tree"].pop(), "certificate_damaged"),
        (lambda d: _swap(d, "S", "X"), "certificate_damaged"),
        (lambda d: d["witness"].pop(), "certificate_damaged"),
        (lambda d: d.update(version=99), "unknown_version"),
        (lambda d: d.pop("tree"), "missing_key"),
        (lambda d: d.update(size_rad=float("nan")), "not_json"),
        (lambda d: d["witness"].__setitem__(0, ["because", "", None, None]), "bad_value because"),
        (lambda d: d.update(approved=True), "unknown_key approved"),
        (lambda d: d["inputs"].insert(0, {**d["inputs"][0], "sha256": "0" * 64}), "bad_value"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(carton, tmp_path, change, says):
    path = tmp_path / "c.json"
    write_certificate(carton[1], path)
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with refused(*says.split()):
        read_certificate(path)


def test_no_certificate_is_refused(tmp_path):
    path = tmp_path / "c.json"
    for content, code in {"": "file_size", "{": "not_json", "[]": "unknown_version", "\x00": "not_json"}.items():
        path.write_text(content)
        with refused(code):
            read_certificate(path)
    with refused("no_such_file"):
        read_certificate(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("old", "new", "which"), [("R", "S", 0), ("U", "S", -1), ("S", "R", 0), ("U", "R", 0)], ids=str
)
def test_a_flipped_cell_is_refused_even_with_a_matching_summary(carton, old, new, which):
    """The checker proves claims, the first and the last; it does not trust the file's own arithmetic."""
    context, found = carton
    verdict, reason, structure = found.verdict.copy(), found.reason.copy(), found.structure.copy()
    near = (reason == "too_close") if old == "R" else True  # the skin alone says nothing against it
    row = int(np.flatnonzero((verdict == old) & near)[which])
    verdict[row] = new
    reason[row], structure[row] = ("too_close", found.question.structures[0]) if new == "R" else ("", "")
    tree, letters = [], iter(verdict)
    for level in found.tree:
        tree.append("".join(letter if letter.islower() else str(next(letters)) for letter in level))
    forged = replace(found, tree=tuple(tree), verdict=verdict, reason=reason, structure=structure)
    with refused("cell_not_proven", row):
        verify(forged, context.case, context.anatomy)


@pytest.mark.parametrize(
    ("true", "reason"),
    [
        ("too_close", "too_long"),
        ("too_close", "skin_angle"),
        ("too_close", "no_skin_entry"),
        ("too_long", "reenters_skin"),
        ("skin_angle", "too_long"),
        ("skin_angle", "reenters_skin"),
    ],
)
def test_a_false_reason_is_refused(carton, true, reason):
    """A cell that is too close breaks no other constraint; one that is too long, whose skin is known, no second.

    Nor does one that is crossed too flatly, soon and once: only where the skin's place is bounded can that be told.
    """
    context, found = carton
    case = context.case
    if true == "skin_angle":
        case = replace(case, search=replace(case.search, max_skin_angle=np.radians(10.0)))
        found = certify(case, context.anatomy, size=np.radians(6), **QUARTER)
    reasons = found.reason.copy()
    reasons[np.flatnonzero(found.reason == true)[0]] = reason
    with refused("cell_not_proven", reason):
        verify(replace(found, reason=reasons), case, context.anatomy)


def test_a_witness_that_is_none_and_a_large_undecided_cell_are_refused(carton):
    context, found = carton
    row = int(np.flatnonzero(found.reason == "too_close")[0])
    for triangle in (-1, 10**6, 0):
        triangles = found.triangle.copy()
        triangles[row] = triangle
        with refused("cell_not_proven", row):
            verify(replace(found, triangle=triangles), context.case, context.anatomy)
    with refused("cell_not_proven"):
        verify(replace(found, size=found.size / 3), context.case, context.anatomy)


def test_other_inputs_are_refused(carton):
    context, found = carton
    case, anatomy = context.case, context.anatomy
    changed = InputFiles(case.folder)
    for one in case.inputs:
        changed.add(one.role, one.path, case.files.content(one.path) + (b" " if one.path == "skin.ply" else b""))
    others = [
        replace(case, files=changed),
        replace(case, name="other"),
        replace(case, needle=replace(case.needle, diameter_mm=2.1)),
        replace(case, target_ct=case.target_ct + [0, 0, 0.01]),
    ]
    for other in others:
        with refused("input_changed" if other is others[0] else "certificate_of_another"):
            verify(found, other, anatomy)
    thicker = tuple(replace(s, margin_mm=s.margin_mm + 0.1) for s in anatomy.structures)
    with refused("certificate_of_another"):
        verify(found, case, replace(anatomy, structures=thicker))


# caps at the edge of sense


@pytest.mark.parametrize(
    ("theta", "beta"),
    [
        ((0.4, 0.4), (0, 2 * np.pi)),
        ((0.2, 0.5), (1.0, 1.0)),
        ((0.7, 0.7), (2.0, 2.0)),
        ((0, 0), (0, 0)),
        ((np.pi, np.pi), (0, 1)),
    ],
)
def test_a_cap_without_area_is_certified_too(carton, theta, beta):
    context, _ = carton
    found = certify(context.case, context.anatomy, size=np.radians(1), theta=theta, beta=beta)
    assert found.fraction("S") is None
    assert found.areas["S"] == 0
    middles = found.leaves.theta.mean(axis=1), found.leaves.beta.mean(axis=1)
    assert (_agreed(context, context.anatomy, found, *middles) == found.verdict).all()
    assert len(found.leaves) == 1 or (found.verdict != "U").any()  # a pole may run through a vertex
    verify(found, context.case, context.anatomy)


def test_the_whole_sphere_is_certified(carton, rng):
    context, _ = carton
    found = certify(context.case, context.anatomy, size=np.radians(4), theta=(0, np.pi))
    assert sum(found.areas.values()) == pytest.approx(41252.96, rel=1e-6)
    theta, beta = _thrown_into(found.leaves, rng.integers(0, len(found.leaves), 600), rng)
    _agreed(context, context.anatomy, found, theta, beta)


@pytest.mark.parametrize(
    ("theta", "beta", "size"), [((1, 0), None, 1), ((0, 4), None, 1), (None, (0, 7), 1), (None, None, 1e-9)]
)
def test_a_cap_or_size_that_makes_no_sense_is_refused(carton, theta, beta, size):
    context, _ = carton
    with refused("out_of_range"):
        certify(context.case, context.anatomy, size=size, theta=theta, beta=beta)


def test_when_nothing_is_safe_the_map_proves_it(carton):
    context, _ = carton
    structures = tuple(replace(s, margin_mm=60.0) for s in context.anatomy.structures)
    anatomy = replace(context.anatomy, structures=structures)
    found = certify(context.case, anatomy, size=np.radians(8), **QUARTER)
    assert found.areas["S"] == 0
    assert found.fraction("R") == pytest.approx(1)
    verify(found, context.case, anatomy)


@pytest.mark.parametrize(
    ("margin", "size", "says"),
    [
        ("80.0", "4", "proven: no direction of the cap is safe, to 4 deg; "),
        ("29.0", "10", "proven: no direction of the cap is safe, to 10 deg, except perhaps in "),
        ("2.0", "8", "certified to 8 deg: safe "),
    ],
)
def test_the_command_line_says_what_is_proven(tmp_path, capfd, margin, size, says):
    """A margin that nothing keeps, one that is kept in undecided cells at most, and the carton's own; all verified."""
    case = tmp_path / "carton" / "case_m.toml"
    shutil.copytree(folder() / "carton", case.parent)
    text = case.read_text().replace("step_deg = 2.0", "step_deg = 12.0")
    case.write_text(text.replace("margin_mm = 2.0", f"margin_mm = {margin}"))
    options = ["--no-arm", "--no-pictures", "--certify", "--certify-size", size, "--out", str(tmp_path)]
    code = main(["search", str(case), *options])
    said = capfd.readouterr().out
    assert says in said
    assert "not certified: reach of the arm" in said
    assert (code == OK) == (read_certificate(tmp_path / "certificate.json").verdict == "S").any()
    assert main(["verify", str(tmp_path / "certificate.json"), "--case", str(case)]) == OK
    assert says in capfd.readouterr().out


def test_a_target_inside_is_rejected_at_once_and_without_organs_the_skin_decides(carton, ball):
    context, _ = carton
    around = Structure("around", Role.UNKNOWN, 0.0, ball(900, context.case.target_ct), "")
    anatomy = Anatomy((around,), context.anatomy.skin, ())
    found = certify(context.case, anatomy, size=0.1)
    assert found.tree == ("R",)
    assert found.queries == 0
    assert found.structure[0] == "around"
    verify(found, context.case, anatomy)
    anatomy = Anatomy((), context.anatomy.skin, ())
    found = certify(context.case, anatomy, size=np.radians(6), **QUARTER)
    assert found.queries == 0
    assert found.fraction("S") > 0.5
    verify(found, context.case, anatomy)


def test_an_open_skin_is_only_certified_where_it_stands(carton, rng):
    """With a hole in it, directions through the hole are never certified safe, and nothing contradicts the search."""
    context, _ = carton
    mesh = context.anatomy.skin.mesh
    keep = np.ones(len(mesh.faces), bool)
    keep[rng.choice(len(mesh.faces), 12, replace=False)] = False
    skin = Skin(TriangleMesh(mesh.vertices, mesh.faces[keep]), np.zeros(keep.sum(), bool), None, ())
    anatomy = replace(context.anatomy, skin=skin)
    found = certify(context.case, anatomy, size=np.radians(2))
    _agreed(context, anatomy, found, np.arccos(rng.uniform(0, 1, 1000)), rng.uniform(0, 2 * np.pi, 1000))


def test_the_frame_of_the_map_may_be_any(carton, rng):
    context, _ = carton
    found = certify(context.case, context.anatomy, size=np.radians(6))
    tilted = np.eye(4)
    tilted[:3, :3] = entry_frame(EntryAxes(z=(0.3, -0.2, 0.9), x=(1.0, 0.1, 0.0)), Space.LOCAL)
    tilted[:3, 3] = context.case.target_ct
    case = replace(context.case, T_ct_entry=tilted)
    other = certify(case, context.anatomy, size=np.radians(3))
    directions = outward(np.arccos(rng.uniform(0.6, 1, 3000)), rng.uniform(0, 6.28, 3000))
    first = found.at(*angles(directions @ context.case.T_ct_entry[:3, :3]))
    second = other.at(*angles(directions @ tilted[:3, :3]))
    assert not (((first == "S") & (second == "R")) | ((first == "R") & (second == "S"))).any()
    assert (first == second).mean() > 0.7


@pytest.mark.skipif(not REAL_CT.is_dir(), reason="the real CT (totalseg_abdomen_3mm) is not on this machine")
def test_the_real_ct_never_contradicts(rng, tmp_path):
    for file in REAL.iterdir():
        shutil.copy(file, tmp_path)
    for name in ("ct", "labels_v1_normal", "labels_v2_fast"):
        (tmp_path / f"{name}.nii.gz").symlink_to(REAL_CT / f"{name}.nii.gz")
    context = prepare(tmp_path / "case_v2.toml", arm=False)
    cap = {"theta": (np.radians(20), np.radians(60)), "beta": (np.radians(40), np.radians(140))}
    found = certify(context.case, context.anatomy, size=np.radians(2), **cap)
    thrown = _thrown_into(found.leaves, rng.integers(0, len(found.leaves), 500), rng)
    _agreed(context, context.anatomy, found, *thrown)


def test_a_ray_through_an_edge_does_not_turn_the_skin_inside_out():
    """From a target on a scan's grid the direction (3, 5, 4) meets an edge of the flat end: it is inside still."""
    corners = np.array([[x, y, z] for x in (-168.0, 258.0) for y in (-138.0, 288.0) for z in (-60.0, 60.0)])
    assert skin_surface(skin_from_mesh(TriangleMesh(corners, BOX_FACES)), np.zeros(3)).odd


def test_a_certificate_shows_itself(carton):
    """As whole HTML with its map: areas, and what it says nothing about; what cannot be shown does not raise."""
    certificate = carton[1]
    shown = certificate._repr_html_()
    assert "Certificate of carton-m" in shown
    assert "reach of the arm" in shown
    assert shown.count("data:image/png;base64,") == 1
    assert "proven safe for the organs" in shown
    assert replace(certificate, question=None)._repr_html_().startswith("<pre>")
