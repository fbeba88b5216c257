"""Train the network of the benchmark's baseline ``network``, and write its weights.

    python tools/train_network.py bench10 bench11 -o mitsuba_plenoptic/extensions/data/network.npz

Give benchmarks of other seeds than those on which it is to be scored. Captures of the held-out cameras are left out. It
needs the package torch. The same benchmarks, seed and software give the same weights on processors of one kind.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mitsuba_plenoptic.benchmark import CAPTURES, Benchmark
from mitsuba_plenoptic.extensions.data.baselines import Question
from mitsuba_plenoptic.extensions.data.contents import HELD_OUT, capture_of, central_truth, model_of
from mitsuba_plenoptic.extensions.data.network import DEPTHS, costs
from mitsuba_plenoptic.extensions.data.score import inner

HIDDEN, RATE, BATCH = 16, 3e-3, 16


def main(words: list[str] | None = None) -> int:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmarks", nargs="+", type=Path, metavar="BENCHMARK", help="folders of benchmarks")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="FILE.npz")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--epochs", type=int, default=40)
    given = parser.parse_args(words)
    examples = [each for folder in given.benchmarks for each in examples_of(Benchmark(folder))]
    layers = train(examples, given.seed, given.epochs)
    np.savez(given.output, **layers)
    print(f"{given.output}: {sum(array.size for array in layers.values())} weights from {len(examples)} captures")
    return 0


def examples_of(made: Benchmark) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return what the network sees of each capture by a training camera, and the inverse depths, NaN if not scored."""
    found = []
    for index in made.entries():
        sample = made[index]
        if made.name(index)[1] in HELD_OUT:
            continue
        truth = central_truth(sample)
        # In mirrors the depth of the image is the one that views agree on.
        inverse = np.where(truth["glass"], np.nan, 1 / truth["virtual_depth"])
        scored = np.full_like(inverse, np.nan)
        part = tuple(inner(size) for size in inverse.shape)
        scored[part] = inverse[part]
        for name in CAPTURES:
            question = Question(capture_of(sample, name), made.white(index, model_of(name)))
            found.append((costs(question.light_field, question.camera), scored.astype(np.float32)))
    return found


def train(examples: list[tuple[np.ndarray, np.ndarray]], seed: int, epochs: int) -> dict[str, Any]:
    """Return the kernels and biases that fit the inverse depths best, in the mean absolute difference."""
    torch.manual_seed(seed)
    torch.use_deterministic_algorithms(True)
    network = layers_of()
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    inverse = torch.tensor(1 / DEPTHS, dtype=torch.float32)
    unit = float(inverse.max() - inverse.min())
    random = np.random.default_rng(seed)
    batches = batches_of(examples)
    for epoch in range(epochs):
        total = []
        for number in random.permutation(len(batches)):
            seen, truth = batches[number]
            turn, flip = int(random.integers(4)), bool(random.integers(2))
            seen, truth = (turned(each, turn, flip) for each in (seen, truth))
            found = torch.einsum("k,nkts->nts", inverse, torch.softmax(network(seen), dim=1))
            known = torch.isfinite(truth)
            loss = ((found - truth)[known] / unit).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total.append(loss.item())
        schedule.step()
        if epoch % 10 == 9:
            print(f"epoch {epoch + 1}: mean difference {np.mean(total):.4f} of the range", flush=True)
    made = {}
    for number, layer in enumerate(network[::2]):
        made[f"kernel_{number}"] = layer.weight.detach().numpy()
        made[f"bias_{number}"] = layer.bias.detach().numpy()
    return made


def layers_of() -> Any:
    """Return the network: every second layer is a convolution."""
    count, options = len(DEPTHS), {"padding": 1, "padding_mode": "replicate"}
    return torch.nn.Sequential(
        torch.nn.Conv2d(count + 1, HIDDEN, 3, **options),
        torch.nn.ReLU(),
        torch.nn.Conv2d(HIDDEN, HIDDEN, 3, **options),
        torch.nn.ReLU(),
        torch.nn.Conv2d(HIDDEN, count, 1),
    )


def batches_of(examples: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[Any, Any]]:
    """Return examples of equal shape together."""
    by_shape: dict[tuple[int, ...], list[tuple[np.ndarray, np.ndarray]]] = {}
    for each in examples:
        by_shape.setdefault(each[0].shape, []).append(each)
    order = np.random.default_rng(0)
    found = []
    for group in by_shape.values():
        order.shuffle(group)
        for start in range(0, len(group), BATCH):
            parts = zip(*group[start : start + BATCH], strict=True)
            found.append(tuple(torch.from_numpy(np.stack(part)) for part in parts))
    return found


def turned(array: Any, turn: int, flip: bool) -> Any:
    """Turn pictures by right angles and mirror them, which changes no depth."""
    array = torch.rot90(array, turn, dims=(-2, -1))
    return torch.flip(array, dims=(-1,)) if flip else array


if __name__ == "__main__":
    raise SystemExit(main())
