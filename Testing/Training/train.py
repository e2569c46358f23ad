"""Train the contrast network on pictures by formula; see README.md beside this file.

    python Testing/Training/train.py --steps 4500 --seed 0 --output MedColorLib/features/contrast_net.safetensors

One thread, float32, everything seeded, steps counted: the same command on the same machine makes the same weights.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import time
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from pictures import Anatomy, Pair, make_anatomy, make_pair
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from MedColorLib.features.contrast_net import STRIDE, ContrastNet

RATE, DECAY, WARM_UP = 3e-3, 1e-4, 200
MEAN_DECAY = 0.997  # of the running mean of the weights
KEEP_EVERY = 500
TEMPERATURE = 0.07
POINTS, TISSUE_POINTS = 256, 128  # of a picture that look for their counterpart
PLACES = 1024  # of a picture that they are compared with
NEAR_PX = 6.0  # positions nearer than this to the truth are neither right nor wrong
TISSUE_WEIGHT = 1.0  # of the question for the tissue beside the one for the place
SAME_TISSUE = 0.3  # how much a wrong place in the right tissue counts: hue follows tissue, not place
BATCHES = ((128, 4), (192, 2), (256, 1))  # side of a picture and pairs per step, about equal work
BATCH_SHARES = (0.5, 0.3, 0.2)
POOL, STEPS_PER_ANATOMY = 64, 2  # anatomies that are drawn from; after so many steps one of them is replaced


class Anatomies:
    """A pool of anatomies, renewed one by one: making one takes as long as four pairs of views of it."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 10])
        self._pool = [self._make() for _ in range(POOL)]

    def _make(self) -> tuple[Anatomy, Anatomy]:
        seed, size = int(self._rng.integers(2**62)), int(self._rng.choice([160, 208, 256, 320]))
        own = make_anatomy(seed, size)
        level = self._rng.uniform(0.05, 0.4) if self._rng.random() < 0.5 else 0.0
        return own, make_anatomy(seed, size, level) if level else own

    def renew(self) -> None:
        self._pool[self._rng.integers(POOL)] = self._make()

    def pairs(self, rng: np.random.Generator, side: int, count: int) -> list[Pair]:
        big = [levels for levels in self._pool if len(levels[0].labels) >= side]
        return [make_pair(rng, big[rng.integers(len(big))], side) for _ in range(count)]


def at_cells(plane: np.ndarray) -> np.ndarray:
    """(side, side) -> (side / 4, side / 4): mean over a cell."""
    size = plane.shape[1] // STRIDE, plane.shape[0] // STRIDE
    return cv2.resize(plane.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def pair_loss(first: torch.Tensor, second: torch.Tensor, pair: Pair, rng: np.random.Generator):
    """InfoNCE both ways of one pair, for place and for tissue; None where too little is seen in both.

    Args:
        first, second: (C, h, w) unit features.

    Returns:
        loss, and the share of points whose counterpart looks more alike than anything farther than NEAR_PX.
    """
    height, width = first.shape[1:]
    x, y = at_cells(pair.x), at_cells(pair.y)
    valid = np.flatnonzero(at_cells(pair.valid) > 0.9)
    if len(valid) < 48:
        return None
    points = rng.choice(valid, min(POINTS, len(valid)), replace=False)
    truth = torch.from_numpy(np.stack([x.flat[points], y.flat[points]], -1))  # pixels of the first picture
    scale = torch.tensor([2 / pair.first.shape[1], 2 / pair.first.shape[0]])
    where = ((truth + 0.5) * scale - 1)[None, None]
    own = F.normalize(F.grid_sample(first[None], where, align_corners=False)[0, :, 0].T, dim=1)
    other = second.flatten(1).T[torch.from_numpy(points)]
    kept = rng.choice(height * width, min(PLACES, height * width), replace=False)
    rows, cols = np.divmod(kept, width)
    centres = torch.from_numpy(np.stack([cols, rows], -1).astype(np.float32)) * STRIDE + (STRIDE - 1) / 2
    elsewhere = torch.from_numpy(np.stack([x.flat[kept], y.flat[kept]], -1))
    middle = np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    tissue, tissue2 = (
        torch.from_numpy(v[middle].astype(np.int64)).flatten() for v in (pair.first_tissue, pair.second_tissue)
    )
    of_points = tissue2[torch.from_numpy(points)]
    kept = torch.from_numpy(kept)
    first, second, tissue, tissue2 = first.flatten(1)[:, kept], second.flatten(1)[:, kept], tissue[kept], tissue2[kept]
    forward, hit = _same_place(other, own, first, truth, centres, tissue, of_points)
    backward, _ = _same_place(own, other, second, truth, elsewhere, tissue2, of_points)
    there = _same_tissue(second, first, tissue2, tissue, rng)
    back = _same_tissue(first, second, tissue, tissue2, rng)
    return 0.5 * (forward + backward) + 0.5 * TISSUE_WEIGHT * (there + back), hit


def _same_place(queries, keys, others, truth, places, tissue, own_tissue):
    """Every query against its key and all positions of the other picture.

    Args:
        queries, keys: (P, C). others: (C, M), places (M, 2), tissue (M,) of all positions. truth: (P, 2), own_tissue: (P,).
    """
    right = (queries * keys).sum(1, keepdim=True) / TEMPERATURE
    logits = (queries @ others / TEMPERATURE).masked_fill(tissue == 0, -1e4)
    logits = logits.masked_fill(torch.cdist(truth, places) < NEAR_PX, -1e4)
    hit = (right.detach()[:, 0] > logits.detach().amax(1)).float().mean()
    logits = logits + math.log(SAME_TISSUE) * (tissue[None] == own_tissue[:, None])
    return F.cross_entropy(torch.cat([right, logits], 1), torch.zeros(len(queries), dtype=torch.long)), float(hit)


def _same_tissue(own, others, own_tissue, tissue, rng: np.random.Generator):
    """Positions (C, M) against all of the other picture: any of the same tissue is right, wherever it lies.

    This is what a section asks whose neighbour lacks the organ that lies there.
    """
    known = torch.isin(own_tissue, tissue[tissue > 0]).nonzero()[:, 0].numpy()
    if len(known) == 0:
        return torch.zeros(())
    points = torch.from_numpy(rng.choice(known, min(TISSUE_POINTS, len(known)), replace=False))
    logits = (own[:, points].T @ others / TEMPERATURE).masked_fill(tissue == 0, -1e4)
    right = logits.masked_fill(own_tissue[points][:, None] != tissue, -1e4)
    return (logits.logsumexp(1) - right.logsumexp(1)).mean()


def train(steps: int, seed: int, say=print, keep=None, every: int = 50) -> tuple[ContrastNet, list[dict]]:
    """Return the network, its weights averaged over the last thousand steps or so, and the log.

    Args:
        say: called with every row of the log. keep: called with the network now and then.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 11])
    anatomies = Anatomies(seed)
    network = ContrastNet().to(memory_format=torch.channels_last)
    mean = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(MEAN_DECAY))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    log, losses, hits, started, made = [], [], [], time.process_time(), 0.0
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / WARM_UP) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        before = time.process_time()
        if step % STEPS_PER_ANATOMY == 0:
            anatomies.renew()
        side, count = BATCHES[rng.choice(len(BATCHES), p=BATCH_SHARES)]
        pairs = anatomies.pairs(rng, side, count)
        made += time.process_time() - before
        views = np.stack([p.first for p in pairs] + [p.second for p in pairs])[:, None]
        features = network(torch.from_numpy(views).contiguous(memory_format=torch.channels_last))
        found = [pair_loss(features[k], features[count + k], pair, rng) for k, pair in enumerate(pairs)]
        found = [one for one in found if one is not None]
        if not found:
            continue
        loss = sum(one[0] for one in found) / len(found)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        mean.update_parameters(network)
        losses.append(loss.item())
        hits.append(sum(one[1] for one in found) / len(found))
        if (step + 1) % every == 0 or step + 1 == steps:
            row = {
                "step": step + 1,
                "loss": round(float(np.mean(losses)), 4),
                "right_place": round(float(np.mean(hits)), 4),
            }
            row.update(cpu_seconds=round(time.process_time() - started, 1), cpu_seconds_pictures=round(made, 1))
            log.append(row)
            say(row)
            if keep is not None and (step + 1) % KEEP_EVERY == 0:
                keep(mean.module)
            losses, hits = [], []
    return mean.module, log


def save(network: ContrastNet, path: Path, seed: int, steps: int) -> None:
    """Write the weights in half precision, under a temporary name first.

    One entry of metadata only: safetensors writes several in any order, and the file would have another hash every time.
    """
    from safetensors.torch import save_file

    tensors = {name: value.detach().half().contiguous() for name, value in network.state_dict().items()}
    temporary = path.with_name(path.name + ".part")
    save_file(tensors, str(temporary), metadata={"made_by": f"train.py --steps {steps} --seed {seed}"})
    temporary.replace(path)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=4500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, required=True, help="the safetensors file")
    parser.add_argument("--log", type=Path, help="a JSON file for the log")
    wanted = parser.parse_args()
    network, log = train(
        wanted.steps,
        wanted.seed,
        lambda row: print(row, flush=True),
        lambda now: save(now, wanted.output, wanted.seed, wanted.steps),
    )
    save(network, wanted.output, wanted.seed, wanted.steps)
    if wanted.log:
        about = {"steps": wanted.steps, "seed": wanted.seed, "torch": torch.__version__, "numpy": np.__version__}
        about["sha256"] = hashlib.sha256(wanted.output.read_bytes()).hexdigest()
        wanted.log.write_text(json.dumps({**about, "rows": log}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
