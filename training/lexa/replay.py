"""What LEXA has lived through: its episodes in the room, kept in the folder of the training run."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from saccade.shared.errors import SaccadeError
from saccade.shared.files import writing


class Episode(NamedTuple):
    """Images [T + 1, 32, 32, 3] uint8, and the actions [T, 6] between them, each from -1 to 1."""

    images: NDArray[np.uint8]
    actions: NDArray[np.float32]


class Sequences(NamedTuple):
    """B pieces of episodes: images [B, L, 3, 32, 32] (0 to 1), the action before each image [B, L, 6], and the sum of
    the actions from the episode's first image on [B, L, 6]."""

    images: Tensor
    actions: Tensor
    travelled: Tensor


class Replay:
    """The episodes of a run. Raises SaccadeError if a file is damaged."""

    def __init__(self, folder: Path, count: int) -> None:
        self.folder = folder
        self.episodes = [self._read(number) for number in range(count)]

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:05}.npz"

    def _read(self, number: int) -> Episode:
        path = self._path(number)
        try:
            with np.load(path, allow_pickle=False) as file:
                return Episode(file["images"], file["actions"])
        except (OSError, ValueError, KeyError) as error:
            raise SaccadeError(f"episode {path} is missing or damaged ({error}): remove the run's folder to train "
                               "anew") from error

    def add(self, episode: Episode) -> None:
        """Keeps a new episode, also in a file."""
        path = self._path(len(self.episodes))
        with writing(path, "episode"):
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(path, images=episode.images, actions=episode.actions)
        self.episodes.append(episode)

    @property
    def steps(self) -> int:
        """How many actions all episodes have."""
        return sum(len(episode.actions) for episode in self.episodes)

    def sequences(self, count: int, length: int, rng: np.random.Generator, device: torch.device) -> Sequences:
        """Draws pieces of `length` images from random places of random episodes that are as long."""
        images, actions, travelled = [], [], []
        long = [episode for episode in self.episodes if len(episode.images) >= length]
        for _ in range(count):
            episode = long[int(rng.integers(len(long)))]
            start = int(rng.integers(len(episode.images) - length + 1))
            images.append(episode.images[start:start + length])
            before = np.concatenate([np.zeros((1, episode.actions.shape[1]), np.float32), episode.actions])
            actions.append(before[start:start + length])
            travelled.append(before.cumsum(0)[start:start + length])
        stacked = torch.from_numpy(np.stack(images)).to(device)
        return Sequences(stacked.permute(0, 1, 4, 2, 3).float() / 255.0,
                         *(torch.from_numpy(np.stack(each)).to(device) for each in (actions, travelled)))

    def views(self, count: int, rng: np.random.Generator, device: torch.device) -> tuple[Tensor, Tensor]:
        """Draws images [count, 3, 32, 32] (0 to 1) that were seen, and the sums of the actions before them [count, 6].
        """
        images, travelled = [], []
        for number in rng.integers(len(self.episodes), size=count):
            episode = self.episodes[number]
            at = int(rng.integers(len(episode.images)))
            images.append(episode.images[at])
            travelled.append(episode.actions[:at].sum(0))
        stacked = torch.from_numpy(np.stack(images)).to(device)
        return stacked.permute(0, 3, 1, 2).float() / 255.0, torch.from_numpy(np.stack(travelled)).to(device)
