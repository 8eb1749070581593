"""Figures of campaigns: what is drawn, what sets a scale, and that nothing overlaps."""

import dataclasses
from itertools import pairwise

import drawn
import numpy as np
import pytest
from cases import swept
from matplotlib.colors import to_rgb

from jaxslam import plot
from jaxslam.catalog import ALL, KINDS
from jaxslam.consistency import Average
from jaxslam.results.plot import (
    SHADE,
    TEXT,
    _landmarks,
    _measure_figures,
    _panels,
    _pose_errors,
    _style,
    look,
    panels_of,
)

FIVE = ("dead_reckoning", "ekf", "fej", "right_invariant", "fastslam1")
TWELVE = (*FIVE, "localization", "ideal", "oc", "ukf", "seif", "batch_map", "fastslam2")
OVER_STEPS = (
    plot.nees_figure,
    plot.rmse_figure,
    plot.coverage_figure,
    plot.whiteness_figure,
    plot.gained_figure,
)
FIGURES = (*OVER_STEPS, plot.cost_figure, _pose_errors.run_errors_figure, _landmarks.run_map_figure)


@pytest.fixture(scope="module")
def five():
    return drawn.campaign(FIVE)


@pytest.fixture(scope="module")
def campaign_of_all():
    return drawn.campaign(ALL)


def line(axes, label):
    (curve,) = [
        candidate
        for candidate in _style.curves_of(axes)
        if candidate.get_label().split(" (")[0] == label
    ]
    return curve


def beyond(axes):
    return [artist for artist in axes.lines if artist.get_gid() == _panels.BEYOND]


def panels(figure):
    return [axes for axes in figure.axes if axes.axison]


def named(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def title(figure):
    return figure.legends[0].get_title().get_text().replace("\n", " ")


def kinds(figure, columns):
    """[(kind, its panels, the names in its legend)]."""
    grid = np.array(figure.axes).reshape(-1, columns + 1)
    return [
        (
            row[0].get_ylabel().replace("\n", " "),
            row[:-1],
            [text.get_text().split(" (")[0] for text in row[-1].get_legend().texts],
        )
        for row in grid
    ]


def test_filters_are_told_apart_by_colour_and_without():
    thirty = [look(i) for i in range(30)]
    assert len({(each["color"], each["ls"]) for each in thirty}) == 30
    assert len({each["color"] for each in thirty}) == 6
    for five in (thirty[:5], thirty[5:10]):
        assert len({each["ls"] for each in five}) == len({each["marker"] for each in five}) == 5


@pytest.mark.parametrize(
    ("low", "high", "scale"), [(2.0, 8.0, "linear"), (0.5, 50.0, "log"), (3.0, 1e4, "log")]
)
def test_an_ordinate_is_logarithmic_beyond_a_decade_and_has_numbers(low, high, scale):
    _, (axes,) = panels_of(5.0, 3.0, 1)
    _panels.set_positive(axes, low, high)
    assert axes.get_yscale() == scale
    bottom, top = axes.get_ylim()
    assert bottom < low < high < top
    shown = []
    for axis in (axes.yaxis.major, axes.yaxis.minor):
        ticks = [tick for tick in axis.locator() if bottom <= tick <= top]
        shown += filter(None, axis.formatter.format_ticks(ticks))
    assert len(shown) >= 2


def drawn_looks(figure):
    """{(filter, colour, mark)} of the lines of filters in a figure."""
    lines = [each for axes in figure.axes for each in axes.lines if len(each.get_xdata())]
    found = [(each.get_label().split(" (")[0], each) for each in lines]
    return {(name, each.get_color(), each.get_marker()) for name, each in found if name in TWELVE}


@pytest.mark.parametrize("names", swept([FIVE, [*TWELVE]], FIVE))
def test_a_filter_has_one_look_in_all_figures(names):
    campaign = drawn.campaign(names)
    numbers = _panels.numbers_of(names)
    expected = {n: (look(i)["color"], look(i)["marker"]) for n, i in numbers.items()}
    assert len(set(expected.values())) == len(names)
    for draw in (*OVER_STEPS, plot.cost_figure):
        seen = drawn_looks(draw(campaign))
        assert len(seen) >= len(names) / 2
        assert {(name, *expected[name]) for name, *_ in seen} == seen
    for _, mine in _panels.kinds_of(list(names)):
        assert len({look(numbers[name])["marker"] for name in mine}) == len(mine)


def test_filters_stand_out_from_the_band():
    band = 1 - 0.35 * (1 - np.array(to_rgb(SHADE)))
    assert (
        min((_luminance(band) + 0.05) / (_luminance(to_rgb(hue)) + 0.05) for hue in _style.HUES)
        > 2.3
    )


def _luminance(rgb):
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def test_every_filter_of_the_family_has_one_kind():
    all_names = [name for names in KINDS.values() for name in names]
    assert sorted(all_names) == sorted(ALL) and max(map(len, KINDS.values())) <= 5


def test_kinds_keep_their_order_and_others_come_last_in_fives():
    names = [*(f"mine{i}" for i in range(7)), "fastslam2", "ukf", "ekf"]
    assert _panels.kinds_of(names) == [
        ("Kalman filter", ["ekf"]),
        ("unscented", ["ukf"]),
        ("particles", ["fastslam2"]),
        ("others", [f"mine{i}" for i in range(5)]),
        ("others", ["mine5", "mine6"]),
    ]


@pytest.mark.parametrize(
    ("draw", "columns"),
    swept(zip(OVER_STEPS, (3, 2, 3, 1, 1), strict=True), (plot.nees_figure, 3)),
)
def test_twenty_filters_are_drawn_by_kind(campaign_of_all, draw, columns):
    rows = kinds(draw(campaign_of_all), columns)
    expected = {kind: list(names) for kind, names in KINDS.items()}
    if draw is plot.gained_figure:
        watched = [
            n for n, s in campaign_of_all.filters.items() if "rotation_information" in s.curves
        ]
        expected = dict(_panels.kinds_of(watched))
    assert [kind for kind, *_ in rows] == list(expected)
    for kind, axes, names in rows:
        assert [name.split(":")[0] for name in names] == expected[kind]
        assert all(len(_style.curves_of(panel)) == len(names) for panel in axes)


def test_nees_is_drawn_with_its_band_and_verdicts(five):
    figure = plot.nees_figure(five)
    assert [axes.get_ylabel() for axes in figure.axes] == [
        f"{block} NEES (dof {dof})" for block, dof in drawn.DOF.items()
    ]
    expected = ["95 % band", "honest", "dead_reckoning (consistent)", "ekf (optimistic)"]
    assert named(figure)[:4] == expected
    for axes, block in zip(figure.axes, drawn.DOF, strict=True):
        np.testing.assert_array_equal(
            line(axes, "ekf").get_ydata(), five.filters["ekf"].curves[f"nees_{block}"]
        )
    (axes,) = plot.nees_figure(five, blocks=("heading",)).axes
    assert axes.get_ylabel() == "heading NEES (dof 1)"


@pytest.mark.parametrize("names", swept([FIVE, [*ALL]], FIVE))
def test_the_band_is_seen_whatever_a_degenerate_covariance_gives(names):
    figure = plot.nees_figure(drawn.campaign(names))
    shown = panels(figure)
    extreme = [
        axes
        for axes in shown
        if any(c.get_label()[:9] == "fastslam1" for c in _style.curves_of(axes))
    ]
    for at, axes in enumerate(shown):
        dof = list(drawn.DOF.values())[at % 3]
        (band,) = axes.collections
        heights = band.get_paths()[0].vertices[:, 1]
        low, high = axes.get_ylim()
        np.testing.assert_allclose([heights.min(), heights.max()], [0.7 * dof, 1.3 * dof])
        assert low < heights.min() and heights.max() < high <= 150 * dof
        assert np.log(heights.max() / heights.min()) > 0.06 * np.log(high / low)
        if axes in extreme:
            curve = line(axes, "fastslam1")
            assert curve.get_ydata().max() > 1e26
            marks = [mark for mark in beyond(axes) if mark.get_color() == curve.get_color()]
            x = np.concatenate([mark.get_xdata() for mark in marks])
            assert len(x) and (curve.get_ydata()[x.astype(int) - 1] > high).all()
            assert axes.get_title("right").startswith("↑ to $")
    assert len(extreme) == 3


def test_low_panels_of_nees_have_the_powers_of_ten_and_the_honest_one(campaign_of_all):
    figure = plot.nees_figure(campaign_of_all)
    figure.draw_without_rendering()
    for axes, dof in zip(panels(figure)[:3], drawn.DOF.values(), strict=True):
        low, high = axes.get_ylim()
        shown = [tick for tick in axes.get_yticks() if low <= tick <= high]
        assert {10.0, 100.0} <= set(shown)
        assert dof > 1 or 1.0 in shown


def test_dead_reckoning_does_not_set_the_scale_of_errors(five):
    figure = plot.rmse_figure(five)
    assert named(figure)[-1] == "conditional Cramér-Rao bound"
    for axes, unit in zip(figure.axes, (1, 2), strict=True):
        others = max(line(axes, name).get_ydata().max() for name in FIVE[1:])
        assert axes.get_ylim() == pytest.approx((0.0, 1.06 * others))
        reckoned = line(axes, "dead_reckoning")
        assert reckoned.get_ydata().max() == 40 * unit
        (marks,) = beyond(axes)
        assert marks.get_color() == reckoned.get_color()
        assert axes.get_title("right") == f"↑ to {40 * unit}"
    # Alone, it does; and so does a filter that is merely worse than another.
    alone = plot.rmse_figure(drawn.campaign(["dead_reckoning"])).axes[0]
    assert alone.get_ylim()[1] > 40 and not beyond(alone)
    pair = drawn.campaign(["localization", "ekf"])
    assert not beyond(plot.rmse_figure(pair).axes[0])
    bare = {name: c for name, c in five.filters["ekf"].curves.items() if name[:5] != "bound"}
    without = dataclasses.replace(five.filters["ekf"], curves=bare)
    assert named(plot.rmse_figure(drawn.campaign("a", filters={"a": without}))) == ["a"]


def test_coverage_is_drawn_about_the_diagonal(five):
    figure = plot.coverage_figure(five)
    figure.draw_without_rendering()
    for axes, (block, dof) in zip(figure.axes, drawn.DOF.items(), strict=True):
        assert axes.get_title("left") == f"{block} (dof {dof})"
        assert axes.get_box_aspect() == 1
        gap = figure.legends[0].get_window_extent().y0 - axes.get_tightbbox().y1
        assert 0 < gap < 0.15 * figure.dpi
        np.testing.assert_array_equal(*axes.lines[0].get_data())
        np.testing.assert_array_equal(line(axes, "ekf").get_xdata(), drawn.LEVELS)
        share = line(axes, "ekf").get_ydata()
        np.testing.assert_array_equal(share, five.filters["ekf"].coverage[block])


def test_whiteness_is_drawn_about_zero_and_says_who_has_no_innovations(five):
    figure = plot.whiteness_figure(five)
    (axes,) = figure.axes
    for name in FIVE[1:]:
        curve = line(axes, name)
        np.testing.assert_allclose(curve.get_xdata(), np.arange(1, drawn.LAGS + 1), atol=0.25)
        np.testing.assert_array_equal(curve.get_ydata(), five.filters[name].autocorrelation)
    assert axes.get_ylim()[0] == -axes.get_ylim()[1]
    assert "dead_reckoning: no innovations" in named(figure)
    assert "dead_reckoning" not in named(figure)
    assert len(line(axes, "dead_reckoning: no innovations").get_xdata()) == 0


def test_points_of_cost_stay_off_the_frame(five):
    times, errors, nees = plot.cost_figure(five).axes
    listed = [text.get_text() for text in times.get_yticklabels()]
    assert listed == list(five.filters)
    for row, (name, summary) in enumerate(five.filters.items()):
        for axes, expected in (
            (times, 1e6 * five.step_seconds[name]),
            (errors, summary.measures["rmse_position"].value),
            (nees, summary.measures["nees_pose"].value),
        ):
            if axes is nees and name == "fastslam1":
                continue
            (point,) = [each.get_xydata() for each in axes.lines if each.get_label() == name]
            np.testing.assert_allclose(point, [[expected, row]])
            x, y = axes.transAxes.inverted().transform(axes.transData.transform(point))[0]
            assert 0.05 < x < 0.95 and 0.05 < y < 0.95
    assert [text.get_text() for text in nees.texts] == [r"$3\cdot 10^{27}$"]
    assert nees.get_xlim()[1] < 1e3
    assert times.get_xlabel() == "time of a step [µs]"
    # A campaign that only read its blocks has timed nothing.
    untimed = plot.cost_figure(dataclasses.replace(five, step_seconds={}))
    assert untimed.axes[0].get_xlabel() == "no filter was timed"
    untimed.canvas.draw()


@pytest.mark.parametrize("names", swept([FIVE[:3], [*TWELVE]], FIVE[:3]))
def test_intervals_of_cost_set_the_scale_and_have_an_arrow_where_they_leave_it(names):
    campaign = drawn.campaign(names)
    measures = {
        "dead_reckoning": Average(1.0, 0.3, 4.0),
        "ekf": Average(0.5, 0.4, np.inf),
        "fej": Average(0.5, 1e-4, 2.0),
    }
    for name, s in campaign.filters.items():
        s.measures["rmse_position"] = measures.get(name, Average(0.5, 0.4, 0.6))
    figure = plot.cost_figure(campaign)
    axes = figure.axes[1]
    low, high = axes.get_xlim()
    assert low < 0.3 and 4.0 < high < 10
    drawn_there = [artist for artist in axes.lines if artist.get_gid() == _measure_figures.INTERVAL]
    lines = [artist.get_xdata() for artist in drawn_there if len(artist.get_xdata()) == 2]
    assert len(lines) == len(names)
    for ends in ([0.3, 4.0], [0.4, high], [low, 2.0]):
        assert any(np.allclose(line, ends) for line in lines)
    arrows = {
        artist.get_marker(): artist.get_xdata()[0]
        for artist in drawn_there
        if artist.get_marker() != "None"
    }
    assert arrows == {"<": low, ">": high}


def test_many_filters_are_listed_by_cost(campaign_of_all):
    figure = plot.cost_figure(campaign_of_all)
    times, errors, nees = figure.axes[:3]
    listed = [text.get_text() for text in times.get_yticklabels()]
    assert listed == [name for _, names in _panels.kinds_of(list(ALL)) for name in names]
    for axes in (times, errors):
        left, right = axes.get_xlim()
        points = [point for point in axes.lines if point.get_label() in ALL]
        assert len(points) == len(ALL)
        assert all(left < point.get_xdata()[0] < right for point in points)
    assert nees.get_xlim()[1] < 1e3
    assert r"$3\cdot 10^{27}$" in [text.get_text() for text in nees.texts]


def test_information_gained_is_drawn_for_watched_filters_and_zeros_below_the_axis():
    gained = np.array([0.0, -1e-20, 1e-30, 1e-3, np.nan, *np.linspace(1, 50, drawn.STEPS - 5)])
    found = drawn.campaign(["learns", "honest", "dead_reckoning"])
    for name, values in (("learns", gained), ("honest", np.zeros(drawn.STEPS))):
        found.filters[name].curves["rotation_information"] = values
    figure = plot.gained_figure(found)
    assert named(figure) == ["learns", "honest"]
    assert title(figure).endswith("Not monitored: dead_reckoning")
    (axes,) = figure.axes
    learns, honest = (line(axes, name).get_ydata() for name in ("learns", "honest"))
    np.testing.assert_array_equal(learns[3:], gained[3:])
    assert axes.get_yscale() == "log"
    low, high = axes.get_ylim()
    assert np.all((learns[:3] > low) & (learns[:3] < 1e-6))
    assert np.all((honest > low) & (honest < 1e-6))
    assert not np.isclose(honest[0], learns[0], rtol=0.2)  # each at a height of its own
    assert high > 50
    nobody = plot.gained_figure(drawn.campaign(["dead_reckoning"]))
    assert [text.get_text() for text in nobody.axes[0].texts] == [
        "no filter has an observability monitor (filters.Monitored)"
    ]


@pytest.mark.parametrize("names", swept([["ekf", "fej"], [*ALL]], ["ekf", "fej"]))
def test_labels_of_information_gained_do_not_crowd(names):
    figure = plot.gained_figure(drawn.campaign(names))
    figure.draw_without_rendering()
    axes = figure.axes[0]
    low, high = axes.get_ylim()
    labels = zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
    boxes = [text.get_window_extent() for at, text in labels if low <= at <= high]
    assert len(boxes) >= 3
    boxes.sort(key=lambda box: box.y0)
    assert all(below.y1 < above.y0 for below, above in pairwise(boxes))
    assert axes.get_yticklabels()[0].get_text() == "$< 10^{-6}$"


@pytest.mark.parametrize("draw", FIGURES)
@pytest.mark.parametrize("width", swept([plot.PAGE, plot.COLUMN], plot.COLUMN))
def test_five_filters_fit_a_page_and_a_column_in_letters_of_one_size(five, draw, width):
    figure = draw(five, width=width)
    figure.draw_without_rendering()
    assert figure.get_figwidth() == width
    (legend,) = figure.legends
    page, box = figure.bbox, legend.get_window_extent()
    assert page.x0 <= box.x0 and box.x1 <= page.x1 + 1
    shown = panels(figure)
    for axes in shown:
        extent = axes.get_tightbbox()
        assert page.x0 - 1 <= extent.x0 and extent.x1 <= page.x1 + 2
        assert page.y0 - 1 <= extent.y0 and extent.y1 <= box.y0 + 1
        assert {text.get_size() for text in axes.get_xticklabels()} <= {TEXT}
    _apart(shown)


@pytest.mark.parametrize("draw", swept(FIGURES, plot.nees_figure))
def test_twenty_filters_can_be_read_and_nothing_overlaps(campaign_of_all, draw):
    # Three panels a filter: slow to lay out, and all alike.
    rows = draw is _pose_errors.run_errors_figure
    figure = draw(drawn.campaign(list(ALL)[:7]) if rows else campaign_of_all)
    figure.draw_without_rendering()
    page = figure.bbox
    for axes in figure.axes:
        extent = axes.get_tightbbox()
        assert page.x0 - 1 <= extent.x0 and extent.x1 <= page.x1 + 2
        assert page.y0 - 1 <= extent.y0 and extent.y1 <= page.y1 + 1
    _apart(panels(figure))


def _apart(shown):
    boxes = [axes.get_window_extent() for axes in shown]
    for i, a in enumerate(boxes):
        assert a.width > 30 and a.height > 30
        assert not any(a.shrunk(0.98, 0.98).overlaps(b.shrunk(0.98, 0.98)) for b in boxes[i + 1 :])
    labels = [axes.yaxis.label.get_window_extent() for axes in shown if axes.get_ylabel()]
    for i, a in enumerate(labels):
        assert not any(a.overlaps(b) for b in labels[i + 1 :])


@pytest.mark.parametrize("draw", [*OVER_STEPS, plot.cost_figure])
@pytest.mark.parametrize("count", swept([1, 6], 1))
def test_filters_without_a_number_and_single_steps_can_be_drawn(draw, count):
    ekf = drawn.summary("ekf")
    lost = dataclasses.replace(
        ekf,
        curves={name: np.full_like(curve, np.nan) for name, curve in ekf.curves.items()},
        coverage={block: np.full_like(share, np.nan) for block, share in ekf.coverage.items()},
        autocorrelation=np.full(drawn.LAGS, np.nan),
        counts=ekf.counts | {"runs": 0},
        measures={},
    )
    once = dataclasses.replace(ekf, curves={n: curve[2:3] for n, curve in ekf.curves.items()})
    others = {f"mine{i}": ekf for i in range(count - 1)}
    for steps, filters in (
        (drawn.STEPS, {"$lost_": lost}),
        (drawn.STEPS, {"_a$": lost} | others),
        (1, {f"a{i}": once for i in range(count)}),
    ):
        times = dict.fromkeys(filters, 1e-4)
        campaign = drawn.campaign([], steps, filters=filters, step_seconds=times)
        figure = draw(campaign)
        figure.draw_without_rendering()
        if draw is not plot.cost_figure:  # there they are tick labels
            assert all(name in _style.describe(figure) for name in filters)


def test_a_figure_is_described_in_words(five):
    said = _style.describe(plot.coverage_figure(five))
    assert "share of truth within" in said
    assert "against probability p" in said
    assert "Drawn: honest, dead_reckoning, ekf, fej," in said
    assert "true path" in _style.describe(_landmarks.run_map_figure(five))


def test_a_notebook_shows_a_figure_as_it_is():
    figure, _ = panels_of(1.0, 1.0, 1)
    assert figure._repr_png_().startswith(b"\x89PNG")
