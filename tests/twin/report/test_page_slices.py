"""The page's block of the CT and its rows, without a browser."""

import gzip

import numpy as np
import pytest
import report_world as world
import scipy
from hypothesis import given, strategies as st

from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report.page.page_data import map_data, picked_row
from puncture_twin.twin.report.page.page_slices import block_box, ct_block
from puncture_twin.twin.report.slices.panel import KNOTS_BYTE, KNOTS_HU


def unpacked_ct(block):
    """Hounsfield units of a block without loss."""
    nx, ny, nz = block.facts["shape"]
    differences = np.frombuffer(gzip.decompress(block.content), np.uint8).reshape(nz, ny, nx)
    values = np.zeros((nz + 1, ny + 1, nx + 1), int)
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                before = values[k + 1, j + 1, i] + values[k + 1, j, i + 1] + values[k, j + 1, i + 1]
                values[k + 1, j + 1, i + 1] = (differences[k, j, i] + before // 3) % 256
    return np.interp(values[1:, 1:, 1:], KNOTS_BYTE, KNOTS_HU).transpose(2, 1, 0)


def oblique(shape, spacing):
    """An image of random soft tissue whose axes are a little turned, and its map."""
    turn = np.linalg.qr(np.eye(3) + 0.1 * np.random.default_rng(1).normal(size=(3, 3)))[0]
    T = np.eye(4)
    T[:3, :3] = turn * np.sign(np.diag(turn)) * spacing
    T[:3, 3] = [-20.0, 30.0, 5.0]
    return np.random.default_rng(2).integers(-160, 240, shape).astype(np.int16), T


def test_a_block_holds_the_voxels_where_they_lie():
    """Every voxel in the box, at its place, to half a step of the table; the image's ends are where they were."""
    hu, T = oblique((12, 10, 8), (2.0, 2.5, 3.0))
    middle = (T @ [6, 5, 4, 1])[:3]
    block = ct_block(hu, T, np.stack([middle - 4, middle + 4]))
    found, T_block = unpacked_ct(block), world.block_pose(block)
    assert found.size < hu.size
    for index in np.ndindex(*found.shape):
        at = np.linalg.solve(T, T_block @ [*index, 1])[:3]
        assert np.allclose(at, np.round(at)) and abs(found[index] - hu[tuple(np.round(at).astype(int))]) <= 1.7
    ends = [np.linalg.solve(T, T_block @ [*end, 1])[:3] for end in block.facts["image"]]
    assert np.allclose(ends, [[-0.5] * 3, np.array(hu.shape) - 0.5])


def test_voxels_too_many_for_the_page_become_a_millimetre():
    """Means over a millimetre, also of parts of voxels, at the middle of what they are of; coarser axes stay."""
    hu, T = oblique((60, 60, 16), (0.7, 0.4, 3.0))
    hu[:] = 3 * np.arange(60)[:, None, None] + hu % 60
    box = np.stack([T[:3, 3] - 100, T[:3, 3] + 100])
    whole = ct_block(hu, T, box)
    assert "strips" not in whole.facts and whole.facts["shown_mm"] == whole.facts["voxel_mm"] == [0.7, 0.4, 3.0]
    less = ct_block(hu, T, box, most=len(whole.content) // 2)
    assert less.facts["shown_mm"] == [1.0, 1.0, 3.0] and less.facts["shape"] == (42, 24, 16)
    place = np.linalg.solve(T, world.block_pose(less) @ [20, 4, 5, 1])
    assert place[:3] == pytest.approx([20.5 / 0.7 - 0.5, 4.5 / 0.4 - 0.5, 5])
    assert decoded(less)[20].mean() == pytest.approx(3 * place[0] + 29.5, abs=2)


def decoded(block):
    """Hounsfield units of a block with loss."""
    return np.interp(world.unpacked_bytes(block), KNOTS_BYTE, KNOTS_HU).transpose(2, 1, 0)


def test_a_noisy_ct_is_packed_with_the_loss_that_is_stated():
    """20 HU of noise in the room that a page has for each voxel: a millimetre, 12 HU (rms); means over 5 mm to 3 HU."""
    scan = world.make_noisy_scan()
    hu, T = scan.measured
    box = np.stack([world.TARGET - 60, world.TARGET + 60])
    block = ct_block(hu, T, box, most=world.NOISY_BYTES)
    facts = block.facts
    assert facts["shown_mm"] == [1.0, 1.0, 1.0] and len(block.content) <= world.NOISY_BYTES
    exact = ct_block(hu, T, box, most=10**9)
    assert "strips" not in exact.facts and len(exact.content) > 3 * world.NOISY_BYTES
    index = np.moveaxis(np.indices(facts["shape"]), 0, -1)
    T_block = world.block_pose(block)
    at = index @ T_block[:3, :3].T + T_block[:3, 3]
    inside = np.linalg.norm(at - world.TARGET, axis=-1) < world.SKIN_RADIUS - 5
    mean = scipy.ndimage.uniform_filter(np.where(inside, decoded(block) - scan.quiet(at), 0.0), 5)
    deep = scipy.ndimage.binary_erosion(inside, iterations=4)
    assert np.abs(mean[deep]).max() < 12 and np.sqrt(np.square(mean[deep]).mean()) < 3
    assert facts["rms_hu"] < 12 and facts["rms_bytes"] < 8 and facts["worst_hu"] < 400


def test_the_block_holds_target_and_safe_entries(case):
    """With room about them; where nothing is safe, all entries."""
    for safe in (True, False):
        candidates = world.make_candidates(case, safe=safe)
        low, high = block_box(case.target_ct, candidates)
        entries = candidates.path.entry_ct[candidates.safe if safe else slice(None)]
        points = np.concatenate([entries, case.target_ct[None]])
        assert np.allclose([low, high], [points.min(axis=0) - 60, points.max(axis=0) + 60])


@given(st.integers(0, 1367), st.floats(0.3, 2.0))
def test_a_pick_beside_the_grid_is_a_row_more(row, off_deg):
    """One on the grid is its row; of another all columns have one more, with its own angles."""
    case = world.make_case()
    candidates = world.make_candidates(case)
    same, apart = world.make_candidates(case), world.make_candidates(case)
    assert picked_row(candidates, Pick(same, row)) == row and picked_row(candidates, None) == -1
    apart.theta.setflags(write=True)
    apart.theta[row] += np.radians(off_deg)
    assert picked_row(candidates, Pick(apart, row)) == len(candidates)


def test_the_row_more_has_all_columns(case, candidates):
    """Also where the search names other structures than the check."""
    apart = world.make_candidates(case)
    apart.theta.setflags(write=True)
    apart.theta[5] += 0.01
    data = map_data(case, candidates, Pick(apart, 5))
    count = len(candidates) + 1
    columns = ("theta", "beta", "reason", "structure", "sentence", "depth", "amount", "near", "path", "rank", "window")
    assert data["picked"] == data["first"] == count - 1 and {len(data[name]) for name in columns} == {count}
    assert len(data["outward"]) == 3 * count and data["theta"][-1] == pytest.approx(
        np.degrees(apart.theta[5]), abs=1e-3
    )
    assert data["structures"][data["near"][-1][0]] == "rib_right_9" and data["near"][-1][1] == pytest.approx(
        apart.clearance.by_structure[5, 0], abs=1e-3
    )
