"""What every forecaster can do, and TIPL as one.

TIPL as the paper describes it is a causal Transformer on rows of the run's Temporal SVD. It is
marked *not causal*: the basis of each run is fitted to the whole run, its future included, as in
the paper. The Transformer itself sees the past only.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float32
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from tipl.errors import ForecastError, ModelError
from tipl.models.gpt import GPT, GPTConfig
from tipl.representation import embed
from tipl.tokens import history
from weighttraj import Run


@runtime_checkable
class Forecaster(Protocol):
    """Forecasts the weights of a policy some snapshots ahead."""

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        ...

    @property
    def causal(self) -> bool:
        """Whether a forecast from t uses nothing that comes after t."""
        ...

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Forecasts of phi_{t+h} for each start t and horizon h, from phi_0, ..., phi_t.

        Args:
            run: whose weights they are.
            starts: rows of ``run.weights``, from 0, in any order.
            horizons: snapshots ahead, from 1.

        Raises:
            ForecastError: it makes no such forecast, or of no such run.
        """
        ...

    def save(self, path: str | Path) -> None:
        """Write the forecaster into a folder."""
        ...

    @classmethod
    def load(cls, path: str | Path) -> Forecaster:
        """Read what ``save`` wrote."""
        ...


class Pushed:
    """Base of the models that people publish."""

    def push_to_hub(self, repo: str, *, private: bool = False, card: Path | None = None) -> str:
        """Publish on the Hugging Face hub, in one commit: ``tipl.push`` to ``hf://<repo>``.

        Args:
            repo: ``organisation/name``.
            private: of a new repository: only its organisation sees it.
            card: the model's card, Markdown, which it must have.

        Returns:
            The address that ``tipl.load`` takes, with the commit that it is now.

        Raises:
            ForecastError: it has no card.
            RemoteError: the hub cannot be reached, or refuses.
        """
        from tipl.zoo.remote import push

        return push(self, f"hf://{repo}", private=private, card=card)  # type: ignore[arg-type]


def check_request(run: Run, starts: Sequence[int], horizons: Sequence[int]) -> None:
    """Check what a forecaster was asked for.

    Raises:
        ForecastError: a start is no snapshot of the run, or a horizon is below 1.
    """
    if not (
        len(starts)
        and len(horizons)
        and 0 <= min(starts) <= max(starts) < len(run)
        and min(horizons) >= 1
    ):
        raise ForecastError(
            "there is no such forecast",
            expected=f"starts from 0 to {len(run) - 1}, horizons from 1",
            got=f"starts {list(starts)}, horizons {list(horizons)}",
            where=run.path,
        )


def check_cadence(run: Run, every: int | None, phases: int | None = None) -> None:
    """Check that a model is for snapshots like these.

    Args:
        run: what is forecast.
        every: gradient steps from one snapshot to the next in the training runs.
        phases: snapshots in their iterations; None: that does not matter.

    Raises:
        ModelError: the run's are others.
    """
    got = run.info.cadence.every if run.info.cadence else None
    longest = 0 if phases is None else int(run.phase.max()) + 1
    if got != every or longest > (phases or 0):
        raise ModelError(
            "the model was trained on snapshots of another cadence",
            expected=f"a snapshot every {every} gradient steps"
            + (f", at most {phases} in an iteration" if phases else ""),
            got=f"every {got}" + (f", {longest} in an iteration" if phases else ""),
            where=run.path,
            do="train a model on runs of this cadence",
        )


@dataclass(frozen=True, kw_only=True)
class TIPLConfig:
    """What a saved TIPL says of itself."""

    gpt: GPTConfig
    """Sizes of the network."""
    every: int | None
    """Gradient steps from one snapshot to the next in the training runs."""
    parameters: int | None = None
    """Of a policy in the training runs; None: not said."""
    kind: str = "tipl"
    """Which forecaster this is."""


@dataclass(frozen=True)
class TIPL(Pushed):
    """The trained network as a forecaster."""

    model: GPT
    config: TIPLConfig
    name: str = "tipl"
    """Name in tables and figures: of the folder that it was loaded from."""
    kind = "tipl"
    causal = False

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Forecasts by feeding each prediction back as the next token.

        Raises:
            ModelError: the run has another cadence, policies of another size, or goes on after the
                last time embedding.
        """
        check_request(run, starts, horizons)
        self._check(run, max(starts) + max(horizons))
        embedded = embed(run, self.config.gpt.rank)
        rolled = self._roll_out(embedded.coefficients, np.asarray(starts), max(horizons))
        chosen = rolled[:, np.asarray(horizons) - 1]
        return embedded.svd.inverse_transform(chosen).astype(np.float32)

    @torch.no_grad()
    def _roll_out(
        self, coefficients: Float[np.ndarray, "time rank"], starts: np.ndarray, steps: int
    ) -> Float[np.ndarray, "start step rank"]:
        self.model.eval()
        device = self.model.input_mean.device
        tokens, index = history(coefficients, starts, self.config.gpt.block_size)
        tokens, index = tokens.to(device), index.to(device)
        predicted: list[Tensor] = []
        for _ in range(steps):
            following = self.model(tokens, index.clamp(min=0), index >= 0)[:, -1:]
            predicted.append(following)
            tokens = torch.cat([tokens[:, 1:], following], dim=1)
            index = index + 1
        return torch.cat(predicted, dim=1).cpu().numpy()

    def _check(self, run: Run, last: int) -> None:
        check_cadence(run, self.config.every)
        if self.config.parameters not in (None, run.layout.size):
            raise ModelError(
                "the model was trained on policies of another structure",
                expected=f"policies of {self.config.parameters:,} parameters",
                got=f"{run.layout.size:,}",
                where=run.path,
                do="train a model on such runs, or use one that serves policies of any size: "
                "tipl-gate",
            )
        if last > self.config.gpt.max_timestep:
            raise ModelError(
                "the run is longer than the runs that the model was trained on, and time is an "
                "absolute index to it",
                expected=f"forecasts up to snapshot {self.config.gpt.max_timestep}",
                got=last,
                where=run.path,
                do="train on longer runs, or forecast earlier starts",
            )

    def save(self, path: str | Path) -> None:
        """Write model.safetensors and config.json."""
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        save_file(self.model.state_dict(), path / "model.safetensors")
        (path / "config.json").write_text(json.dumps(asdict(self.config), indent=1))

    @classmethod
    def load(cls, path: str | Path) -> TIPL:
        """Read a saved model; every parameter must be there.

        Raises:
            FileNotFoundError: there is no model at the path.
            ModelError: the files do not belong together, or are damaged.
        """
        path = Path(path)
        text = (path / "config.json").read_bytes()
        try:
            config = msgspec.json.decode(text, type=TIPLConfig)
            model = GPT(config.gpt)
            model.load_state_dict(load_file(path / "model.safetensors"), strict=True)
        except (msgspec.DecodeError, SafetensorError, RuntimeError) as error:
            raise ModelError(
                "the model cannot be loaded",
                expected="config.json and model.safetensors as `tipl train` writes them",
                got=error,
                where=path,
                do="train it again, or restore both files from a copy",
            ) from error
        return cls(model, config, path.resolve().name)
