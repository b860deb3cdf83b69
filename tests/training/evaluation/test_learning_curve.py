"""The learning curve and the page of details: what is drawn, said, left out."""

import numpy as np
import polars as pl
import pytest

from rmp_mjx.metric import SUCCESS, Metric, by_name
from rmp_mjx.training.evaluation import curves, learning_curve, plots
from rmp_mjx.training.evaluation.learning_curve import Baseline

METRICS = by_name(
    [
        SUCCESS,
        Metric("collision", "sum", event=True, headline="coll"),
        Metric("grazing", "sum", event=True),
        Metric("torque", "mean", unit="N m"),
        Metric("gap", "min", unit="m", headline="gap"),
    ]
)


def rows(collisions=0.5, size=10, count=20):
    """A run of `count` iterations; it collides ever less."""
    k = np.arange(1, count + 1)
    return pl.DataFrame(
        {
            "iteration": k,
            "steps": size * k,
            "episode/finished": np.ones(count, int),
            "episode/return": -1.0 + 0.1 * k,
            "episode/length": 5.0 + 0 * k,
            "episode/success": np.minimum(0.1 * k, 1.0),
            "episode/gap": 0.01 * k,
            "episode/torque": 2.0 + 0 * k,
            "episode/collision": collisions / k,
            "per_1000_steps/collision": collisions / k,
            "per_1000_steps/grazing": 0.0 * k,
            "learning/kl": 0.01 + 0 * k,
        }
    )


def seeds(*frames):
    return pl.concat(
        [frame.with_columns(seed=pl.lit(k)) for k, frame in enumerate(frames)]
    )


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """`drawn(plot, ...)`: the figure that a plot writes, once it is finished."""
    pages, page = [], learning_curve.plots.page

    def kept(*args):
        manager = page(*args)
        pages.append(manager.__enter__())
        return Handed(manager, pages[-1])

    class Handed:
        def __init__(self, manager, value):
            self.manager, self.value = manager, value

        def __enter__(self):
            return self.value

        def __exit__(self, *error):
            return self.manager.__exit__(*error)

    def draw(plot, *args):
        plot(args[0], METRICS, tmp_path / "picture.png", "a title", *args[1:])
        assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
        figure, axes = pages[-1]
        return figure, {axis.get_title("left"): axis for axis in axes if axis.axison}

    monkeypatch.setattr(learning_curve.plots, "page", kept)
    return draw


def said(figure):
    return figure.get_supxlabel()


def test_the_first_page_has_the_headlines_between_return_and_length(drawn):
    figure, axes = drawn(learning_curve.plot_learning_curve, rows())
    assert (
        list(axes)
        == [
            "Return",
            "Success [%]",
            "Gap [mm]",
            "Collision events per 1,000 steps",
            "Episode length",
        ]
        or list(axes)[-1] == "Episode length [steps]"
    )
    width, _ = figure.get_size_inches() * learning_curve.plots.DPI
    assert width == 1200
    assert axes["Gap [mm]"].lines[0].get_ydata()[-1] == pytest.approx(200.0)


def test_what_is_zero_throughout_is_a_line_of_text(drawn):
    figure, axes = drawn(learning_curve.plot_learning_curve, rows(collisions=0.0))
    assert not any("Collision" in title for title in axes)
    assert "Zero throughout: collision, grazing." in said(figure)
    figure, _ = drawn(learning_curve.plot_learning_curve, rows())
    assert "Zero throughout: grazing." in said(figure)


def test_a_baseline_that_is_not_zero_is_drawn_beside_a_run_that_is(drawn):
    other = Baseline("VICES, 2 seeds", seeds(rows(2.0, 20), rows(1.0, 20)))
    figure, axes = drawn(learning_curve.plot_learning_curve, rows(0.0), other)
    axis = axes["Collision events per 1,000 steps"]
    base, *_, own = axis.lines
    assert base.get_label() == "VICES, 2 seeds" and own.get_label() == "this run"
    assert base.get_color() != own.get_color()
    assert max(base.get_ydata()) > 0.0 == max(own.get_ydata())
    assert max(base.get_xdata()) <= 200  # the run's last step; the baseline goes on
    (legend,) = figure.legends
    assert [t.get_text() for t in legend.get_texts()] == ["this run", "VICES, 2 seeds"]
    assert "collision" in said(figure)


def test_bands_and_axes_of_what_is_never_negative_begin_at_zero(drawn):
    spread = seeds(*(rows(0.2 * k) for k in range(4)))
    figure, axes = drawn(learning_curve.plot_learning_curve, spread)
    for name, axis in axes.items():
        lowest = axis.collections[0].get_paths()[0].vertices[:, 1].min()
        if name == "Return":
            assert lowest < 0.0 and axis.get_ylim()[0] < 0.0
        else:
            assert lowest >= 0.0 and axis.get_ylim()[0] == 0.0
    assert "interquartile mean of the 4 seeds" in said(figure)


def test_a_run_without_a_finished_episode_says_so(drawn):
    none = pl.Series([None] * 20, dtype=pl.Float64)
    empty = rows().with_columns(
        none.alias(n) for n in rows().columns if n.startswith("episode/")
    )
    _, axes = drawn(
        learning_curve.plot_learning_curve,
        empty.with_columns(pl.lit(0).alias("episode/finished")),
    )
    assert [t.get_text() for t in axes["Return"].texts] == ["no episode has finished"]
    assert not axes["Collision events per 1,000 steps"].texts


def test_the_second_page_has_the_rest_once(drawn):
    figure, axes = drawn(learning_curve.plot_details, rows())
    assert list(axes) == ["Torque [N m]", "Learner: kl"]
    assert "Zero throughout: grazing." in said(figure)


def test_the_running_mean_is_the_mean_over_the_windows_episodes():
    """Weights are the finished episodes; an iteration without any has no say."""
    frame = pl.DataFrame(
        {
            "iteration": [1, 2, 3, 4],
            "steps": [10, 20, 30, 40],
            "episode/finished": [1, 3, 0, 2],
            "episode/return": [4.0, 8.0, None, 1.0],
            "per_1000_steps/collision": [0.0, 3.0, 0.0, 3.0],
        }
    )
    smooth = curves.running_mean(frame, "episode/return", 30)
    np.testing.assert_allclose(smooth["episode/return"], [7.0, 7.0, 5.2, 1.0])
    smooth = curves.running_mean(frame, "per_1000_steps/collision", 30)
    np.testing.assert_allclose(smooth["per_1000_steps/collision"], [1.5, 1, 2, 1.5])


def test_the_seeds_of_a_run_are_smoothed_apart():
    both = seeds(rows(0.0), rows(3.0))
    smooth = curves.running_mean(both, "per_1000_steps/collision", 50)
    quiet = smooth.filter(pl.col("seed") == 0)["per_1000_steps/collision"]
    assert (quiet == 0.0).all()


@pytest.mark.parametrize(
    ("count", "last", "shown"),
    [
        (0, 30e3, "0"),
        (10e3, 30e3, "10k"),
        (500e3, 1.5e6, "0.5M"),
        (1.5e6, 1.5e6, "1.5M"),
        (500, 800, "500"),
    ],
)
def test_policy_steps_have_the_unit_of_the_whole_axis(count, last, shown):
    assert learning_curve.plots.steps(count, last) == shown


@pytest.mark.parametrize("touched", [True, False])
def test_histograms_are_pictures_with_or_without_contact(tmp_path, touched):
    peaks = {"one": np.array([0.0, 30.0 * touched]), "two": np.zeros(3)}
    plots.plot_forces(peaks, tmp_path / "f.png", "title")
    gaps = {"one": np.array([0.1, -0.01])}
    plots.plot_clearances(gaps, tmp_path / "c.png", "title")
    for name in ("f.png", "c.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
