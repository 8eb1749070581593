"""The report in a browser, headless: what a reader does, and what the page then shows.

Each test appends a script that acts and leaves what it found in the page; Chromium prints the page
as it is then. One start of the browser takes about two seconds.
"""

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
from html import unescape

import numpy as np
import pytest
from test_page import EVIL, GOOD, campaign, summary

from jaxslam import plot
from jaxslam.consistency import Average
from jaxslam.results.page import page

STEPS = 40
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium: the page is not tried in one")

FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3000")

ACTIONS = """
const all = (what) => [...document.querySelectorAll(what)];
const is = (node) => getComputedStyle(node).display !== "none" && node.getClientRects().length > 0;
const plot = (i) => all(".plot")[i];
const at = (i, share, height) => {
  const box = plot(i).getBoundingClientRect();
  return {clientX: box.left + 54 + share * (box.width - 74), clientY: box.top + height,
          bubbles: true, pointerType: "mouse", pointerId: 1, button: 0};
};
const does = (i, what, share, height) => plot(i).dispatchEvent(new PointerEvent(what, at(i, share, height)));
const key = (i, name, more) => plot(i).dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true, ...more}));
const read = (i) => all(".panel")[i].querySelector(".values").innerText.split("\\n").map(s => s.trim()).filter(Boolean);
const curves = (i) => [...plot(i).querySelectorAll(".curve")].map(c => +c.dataset.filter).sort();
const heads = () => all("thead th").slice(2).filter(is).map(c => c.textContent);
const steps = () => all(".knob input").map(c => +c.value);
const change = (node, value) => { node.value = value; node.dispatchEvent(new Event("change")); };
const found = {};
"""


@pytest.fixture(scope="module")
def html():
    """A page of three filters; the pose NEES of filter i at step t is 3 + i t / 10."""
    step = np.arange(1, STEPS + 1)
    filters = {}
    for i, (name, verdict) in enumerate(
        (("good", "consistent"), (EVIL, "optimistic"), ("lost", "diverged"))
    ):
        base = summary(verdict, GOOD | {"nees_pose": Average((4.0, 9.0, 2.0)[i], 1.0, 20.0)})
        curves = {key: np.resize(curve, STEPS) for key, curve in base.curves.items()}
        curves |= {"nees_pose": 3 + i * step / 10, "rmse_position": 1.0 * step}
        if i == 2:
            curves["nees_pose"][9] = np.nan
        filters[name] = dataclasses.replace(base, curves=curves)
    world = dataclasses.replace(campaign(**filters), steps=STEPS)
    figures = {
        "nees": ("NEES", plot.nees_figure(world)),
        "rmse": ("RMSE", plot.rmse_figure(world)),
        "cost": ("Cost", plot.cost_figure(world)),
    }
    return page(world, f"jaxslam {EVIL}", 1, {}, figures)


def browse(html, tmp_path, script="", flags=("--dump-dom",), width=1400):
    """What Chromium prints of the page once a script has run after the page's own."""
    if script:
        code = f"{{{ACTIONS}{script}\ndocument.body.append(Object.assign(document.createElement('pre'), {{id: 'found', textContent: JSON.stringify(found)}}));}}"
        own = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
        html = html.replace("script-src ", f"script-src 'sha256-{own}' ", 1)
        html = html.replace("</body>", f"<script>{code}</script></body>")
    path = tmp_path / "page.html"
    path.write_text(html, encoding="utf-8")
    command = [
        BROWSER,
        *FLAGS,
        f"--window-size={width},900",
        f"--user-data-dir={tmp_path / 'profile'}",
    ]
    done = subprocess.run(
        [*command, *flags, path.as_uri()], capture_output=True, timeout=120, check=True
    )
    text = done.stdout.decode()
    if not script:
        return text
    said = re.search(r'<pre id="found">(.*?)</pre>', text, re.DOTALL)
    assert said, done.stderr.decode()[-2000:]
    return json.loads(unescape(said[1]))


def test_curves_are_drawn_and_say_their_values_under_the_pointer_and_by_keys(html, tmp_path):
    found = browse(
        html,
        tmp_path,
        """
found.plots = all(".plot").length;
found.titles = all(".panel-head strong").map(c => c.textContent);
found.images = all("figure img").map(is);
found.curves = curves(0);
found.named = all(".chip").map(c => c.textContent);
found.scripts = all("script").length;
does(0, "pointermove", 1, 12);           // the last step, at the top
found.top = read(0);
found.thick = [...plot(0).querySelectorAll(".curve.on")].map(c => +c.dataset.filter);
found.cursors = all(".cursor").length;
does(0, "pointermove", 9 / 39, 160);     // step 10, where one filter has none, at the bottom
found.tenth = read(0);
does(0, "pointerleave", 0.5, 50);
found.left = read(0);
plot(0).focus();
found.first = read(0)[0];
key(0, "End"); key(0, "ArrowLeft");
found.before = read(0)[0];
key(0, "ArrowDown");
found.picked = read(0);
key(0, "Escape");
found.closed = read(0);
""",
    )
    assert found["plots"] == 5
    assert found["titles"][0] == "pose NEES (dof 3)"
    assert found["images"] == [False, False, True]  # that of the cost has no curve
    assert found["curves"] == [0, 1, 2]
    assert found["named"] == ["good", EVIL, "lost"]
    assert found["scripts"] == 3
    assert found["top"] == [
        *("step 40", "lost", "11", "above its 95 % band, 1.5 – 4.5", EVIL, "7", "good", "3"),
        "honest: 3",
    ]
    assert found["thick"] == [2]
    assert found["cursors"] == 5
    assert found["tenth"] == [
        *("step 10", EVIL, "4", "good", "3", "in its 95 % band, 1.5 – 4.5", "honest: 3"),
    ]
    assert found["left"] == []
    assert found["first"] == "step 1" and found["before"] == "step 39"
    assert found["picked"] == [
        *("step 39", "lost", "10.8", EVIL, "6.9", "good", "3", "in its 95 % band, 1.5 – 4.5"),
        "honest: 3",
    ]
    assert found["closed"] == []


def test_filters_are_hidden_and_sorted_in_table_verdicts_and_figures(html, tmp_path):
    found = browse(
        html,
        tmp_path,
        """
const chip = all(".chip");
const [show, none] = all(".knobs > .small");
chip[1].click();
found.hidden = [heads(), curves(0), all(".verdicts li").filter(is).length, chip[1].getAttribute("aria-pressed")];
found.cells = all("tbody tr:not(.group)").map(row => [...row.cells].filter(is).length);
none.click();
found.none = [heads(), curves(0)];
show.click();
const row = all("main tbody th button").find(b => b.textContent.startsWith("pose NEES"));
row.click();
found.up = [heads(), row.closest("tr").innerText.includes("2"), row.parentNode.getAttribute("aria-sort")];
row.click();
found.down = [heads(), all(".verdicts .name").map(c => c.textContent), all(".chip").map(c => c.textContent)];
const choice = document.querySelector("select");
change(choice, "");
found.given = heads();
change(choice, "name");
found.named = heads();
chip[2].dispatchEvent(new MouseEvent("dblclick"));
found.alone = [heads(), curves(0)];
""",
    )
    assert found["hidden"] == [["good", "lost"], [0, 2], 2, "false"]
    assert set(found["cells"]) == {4}
    assert found["none"] == [[], []]
    assert found["up"] == [["lost", "good", EVIL], True, "ascending"]
    assert found["down"] == [[EVIL, "good", "lost"]] * 3
    assert found["given"] == ["good", EVIL, "lost"]
    assert sorted(found["named"]) == sorted(found["given"])
    assert found["alone"] == [["lost"], [2]]


def test_time_is_zoomed_by_dragging_keys_and_numbers_in_every_figure_at_once(html, tmp_path):
    found = browse(
        html,
        tmp_path,
        """
const ticks = (i) => [...plot(i).querySelectorAll("text[text-anchor=middle]")].map(c => +c.textContent).filter(v => !isNaN(v));
found.whole = steps();
does(0, "pointerdown", 9 / 39, 50); does(0, "pointermove", 0.5, 50); does(0, "pointerup", 19 / 39, 60);
found.dragged = steps();
found.ticks = [ticks(0), ticks(4)];
plot(0).focus(); key(0, "0");
found.reset = steps();
key(0, "End"); key(0, "+");
found.closer = steps();
key(0, "+");
found.closest = [...steps(), read(0)[0]];
key(0, "Escape"); key(0, "-"); key(0, "-"); key(0, "-");
found.back = steps();
key(0, "End"); key(0, "+");
key(0, "0", {ctrlKey: true});
found.browsers = steps();
const [from, to] = all(".knob input");
to.value = 12; change(from, 5);
found.typed = steps();
to.value = 3; change(from, 30);
found.refused = steps();
plot(0).dispatchEvent(new MouseEvent("dblclick"));
found.again = steps();
""",
    )
    assert found["whole"] == found["reset"] == found["again"] == [1, STEPS]
    assert found["dragged"] == [10, 20]
    for ticks in found["ticks"]:
        assert ticks and min(ticks) >= 10 and max(ticks) <= 20
    assert found["closer"][1] == STEPS and 18 <= found["closer"][0] <= 22
    first, last, cursor = found["closest"]
    assert last == STEPS and 28 <= first <= 32 and cursor == "step 40"
    assert found["back"] == [1, STEPS]  # without a cursor about the middle
    assert found["browsers"] == found["closer"]  # Ctrl 0 is the browser's
    assert found["typed"] == found["refused"] == [5, 12]


def test_light_and_dark_and_a_narrow_screen(html, tmp_path):
    found = browse(
        html,
        tmp_path,
        """
const theme = document.querySelector(".theme");
const back = () => getComputedStyle(document.body).backgroundColor;
found.auto = theme.textContent;
theme.click(); found.light = [theme.textContent, back()];
theme.click(); found.dark = [theme.textContent, back()];
theme.click(); found.again = theme.textContent;
found.wide = [innerWidth, document.documentElement.scrollWidth];
does(0, "pointermove", 0.5, 50);
found.under = all(".values")[0].getBoundingClientRect().top >= plot(0).getBoundingClientRect().bottom;
found.cursor = all(".cursor").length;
""",
        width=400,
    )
    assert found["auto"] == found["again"] == "colours: auto"
    assert found["light"] == ["colours: light", "rgb(255, 255, 255)"]
    assert found["dark"] == ["colours: dark", "rgb(20, 24, 31)"]
    assert found["wide"][1] <= found["wide"][0] <= 500
    assert found["under"] and found["cursor"] == 5


def test_a_foreign_script_does_not_run_and_without_any_the_page_is_whole(html, tmp_path):
    evil = html.replace("</body>", "<script>document.title = 'ran';</script></body>")
    text = browse(evil, tmp_path)
    assert "<title>ran" not in text and 'class="tools"' in text
    text = browse(html.replace("'sha256-", "'sha256-A"), tmp_path)
    assert 'class="tools"' not in text and 'class="static"' not in text
    assert text.count("<img ") == 3


def test_printed_the_figures_are_the_static_ones(html, tmp_path):
    """Images are objects of their own in a PDF; what the script draws are paths."""
    out = tmp_path / "page.pdf"
    browse(html, tmp_path, flags=(f"--print-to-pdf={out}",))
    assert out.read_bytes().count(b"/Subtype /Image") >= 3
