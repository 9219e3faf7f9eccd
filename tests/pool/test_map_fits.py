"""Fits side by side in a pool: the bits of each alone, what fails, and one whose process is killed."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fit.scenes import TEXTURE, write_fit
from tests.pool.fitting import without_pictures
from tests.pool.inline import Inline
from warp_psdr.distributed import Pool
from warp_psdr.fit import FitConfig, checkpoint, fit
from warp_psdr.fit.run import CHECKPOINT


@pytest.fixture
def configs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[FitConfig]:
    """Three starts of one fit."""
    without_pictures(monkeypatch.setattr)
    config = FitConfig.from_file(write_fit(tmp_path, 4))
    return [replace(config, output=tmp_path / f"out{seed}", seed=seed) for seed in range(3)]


def test_fits_have_the_bits_of_each_alone(configs, tmp_path: Path) -> None:
    found = Pool(Inline(2)).map_fits(configs)
    for config, result in zip(configs, found, strict=True):
        alone = fit(replace(config, output=tmp_path / f"alone{config.seed}"))
        assert result.completed and len(set(result.losses.tolist())) == 4
        np.testing.assert_array_equal(result.losses, alone.losses)
        np.testing.assert_array_equal(result.parameters[TEXTURE], alone.parameters[TEXTURE])


def test_checkpoints_are_neither_lost_nor_ignored(configs) -> None:
    pool = Pool(Inline(2))
    pool.map_fits(configs[:1])
    with pytest.raises(ValueError, match="exists: resume it"):
        pool.map_fits(configs)
    longer = [replace(config, iterations=6) for config in configs]
    assert len(pool.map_fits(longer[:1], overwrite=True)[0].losses) == 6
    with pytest.raises(ValueError, match="two fits write to one folder"):
        pool.map_fits([configs[1], configs[1]], resume=True)


def test_one_that_fails_does_not_stop_the_others(configs) -> None:
    wrong = replace(configs[1], sensors=(5, 6))
    with pytest.raises(ExceptionGroup, match="1 of 3 fits failed") as failed:
        Pool(Inline(2)).map_fits([configs[0], wrong, configs[2]])
    assert "sensor 5" in str(failed.value.exceptions[0])
    assert str(configs[1].output) in failed.value.exceptions[0].__notes__[0]
    for config in (configs[0], configs[2]):
        assert len(checkpoint.load(config.output / CHECKPOINT)[0]["losses"]) == 4


class Dies:
    """A method of saving that ends its process once, after a checkpoint."""

    def __init__(self, mark: Path):
        self._mark, self._save, self._caller = mark, checkpoint.save, os.getpid()

    def __call__(self, *arguments) -> None:
        self._save(*arguments)
        if os.getpid() != self._caller and not self._mark.exists():
            self._mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes would not have the method of saving")
def test_a_fit_goes_on_when_its_process_is_killed(configs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = [fit(replace(config, output=tmp_path / f"alone{config.seed}")) for config in configs]
    monkeypatch.setattr(checkpoint, "save", Dies(tmp_path / "died"))
    with Pool("local", processes=2) as pool:
        found = pool.map_fits(configs)
        assert pool.report.lost > 0
    assert (tmp_path / "died").exists()
    for result, alone in zip(found, expected, strict=True):
        np.testing.assert_array_equal(result.losses, alone.losses)
