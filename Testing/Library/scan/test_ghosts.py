"""Ghosts beside the body: noise of magnitudes brighter than the air's is no tissue; dim tissue and lung are."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.scan.body import find_body

SIDE = 160


def magnitudes(signal: np.ndarray, noise: np.ndarray, seed: int = 0) -> np.ndarray:
    """(k, h, w) uint16: |signal + complex noise|."""
    generator = np.random.default_rng(seed)
    real, imaginary = generator.normal(size=(2, *signal.shape)) * noise
    return np.hypot(signal + real, imaginary).round().astype(np.uint16)


@pytest.fixture
def chest():
    """Signal (4, 160, 160), a round body with a dark lung, and where body and lung are."""
    rows, cols = np.mgrid[:SIDE, :SIDE]
    body = (rows - 80) ** 2 + (cols - 80) ** 2 < 45**2
    lung = (rows - 80) ** 2 + (cols - 65) ** 2 < 18**2
    signal = np.where(lung, 0.0, np.where(body, 300.0, 0.0))
    return np.broadcast_to(signal, (4, SIDE, SIDE)).copy(), body, lung


def ghosted(body: np.ndarray) -> np.ndarray:
    """(160, 160) bool: beside the body, along its rows."""
    rows = body.any(1)
    return rows[:, None] & ~body


def test_ghosts_beside_the_body_are_air_and_said(chest):
    signal, body, _ = chest
    found = find_body(magnitudes(signal, np.where(ghosted(body), 22.0, 4.0)))
    painted = np.stack([found.plane(k) > 0.5 for k in range(4)])
    assert painted[:, body].mean() > 0.99
    assert (painted & ~body).sum() < 0.1 * body.sum() * 4  # 1.25 where they are taken for tissue
    assert "ghosts beside the body" in found.text


def test_lung_in_noise_stays_body(chest):
    signal, body, lung = chest
    found = find_body(magnitudes(signal, np.where(ghosted(body) | lung, 22.0, 4.0)))
    assert all((found.plane(k) > 0.5)[lung].all() for k in range(4))


def test_dim_tissue_at_the_border_is_no_ghost(chest):
    signal, body, _ = chest
    arm = np.zeros_like(body)
    arm[60:100, 118:] = True  # part of it in the body
    signal[:, arm & ~body] = 45.0  # as dim as the ghosts of the test above
    found = find_body(magnitudes(signal, np.full(signal.shape[1:], 4.0)))
    assert all((found.plane(k) > 0.5)[arm].mean() > 0.97 for k in range(4))
    assert "ghosts" not in found.text


def test_a_scan_hardly_above_its_noise_keeps_all(chest):
    signal, body, _ = chest
    ghosts = np.where(body, 4.0, 22.0)
    ghosts[:, :20] = ghosts[:, -20:] = 4.0
    found = find_body(magnitudes(signal * (np.abs(np.arange(SIDE) - 80) < 20), ghosts))
    assert all((found.plane(k) > 0.5)[body & (np.abs(np.arange(SIDE) - 80) < 18)].mean() > 0.97 for k in range(4))
