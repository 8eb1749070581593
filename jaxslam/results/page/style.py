"""The style sheets of the page and of a notebook's fragment, and the policy of the page."""

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""Forbids the browser to load anything."""

_LIGHT = """
  --ink: #1c2330; --soft: #5b6577; --line: #dfe3ea; --back: #fff;
  --card: #f7f8fa; --accent: #0b5a8f; --good: #0a6b47; --good-bg: #dcf3e8; --over: #9c3b00;
  --over-bg: #fde6d6; --under: #22508f; --under-bg: #dfe9f8; --bad: #a3123a; --bad-bg: #fbdfe6;
  --none: #4d5566; --none-bg: #e8eaef;"""

_PARTS = """
p { max-width: 46rem; }
.note { margin: .6rem 0 0; color: var(--soft); font-size: .9rem; }
sup { line-height: 0; }
code { font: .86em/1.5 ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace;
  overflow-wrap: anywhere; }
.verdicts { display: grid; grid-template-columns: repeat(auto-fill, minmax(19rem, 1fr));
  gap: .6rem; margin: 0; padding: 0; list-style: none; }
.verdicts li { display: grid; grid-template-columns: 1fr auto; gap: .1rem .8rem;
  align-items: center; align-content: start; padding: .6rem .8rem; background: var(--card);
  border: 1px solid var(--line); border-radius: .5rem; }
.name { font-weight: 600; overflow-wrap: anywhere; }
.why { grid-column: 1 / -1; color: var(--soft); font-size: .86rem;
  font-variant-numeric: tabular-nums; }
.badge { display: inline-block; padding: .08rem .55rem; border-radius: 1rem; font-size: .82rem;
  font-weight: 600; white-space: nowrap; color: var(--none); background: var(--none-bg); }
.consistent { color: var(--good); background: var(--good-bg); }
.optimistic { color: var(--over); background: var(--over-bg); }
.pessimistic { color: var(--under); background: var(--under-bg); }
.diverged { color: var(--bad); background: var(--bad-bg); }
.scroll { overflow-x: auto; border-top: 2px solid var(--ink); border-bottom: 2px solid var(--ink); }
table { border-collapse: separate; border-spacing: 0; width: 100%; font-size: .86rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: .34rem .7rem; text-align: right; white-space: nowrap; vertical-align: top;
  border-bottom: 1px solid var(--line); }
th:first-child { position: sticky; left: 0; text-align: left; font-weight: 500;
  background: var(--back); }
thead th { vertical-align: bottom; font-weight: 600; border-bottom: 1px solid var(--ink); }
thead th:first-child, thead th:nth-child(2) { font-weight: 500; color: var(--soft); }
tbody:last-child tr:last-child > * { border-bottom: 0; }
tbody tr:hover > * { background: var(--card); }
tr th.sub { padding-left: 1.6rem; color: var(--soft); }
tbody tr.group th { padding-top: 1rem; font-size: .76rem; font-weight: 600; color: var(--soft);
  letter-spacing: .06em; text-transform: uppercase; background: var(--back); }
.honest { color: var(--soft); }
.published { display: block; color: var(--soft); font-size: .92em; font-style: italic; }
figure { margin: 0 0 2rem; break-inside: avoid; }
img { display: block; max-width: 100%; height: auto; padding: .6rem; background: #fff;
  border: 1px solid var(--line); border-radius: .5rem; }
figcaption { max-width: 46rem; margin-top: .5rem; color: var(--soft); font-size: .9rem; }
figcaption strong { color: var(--ink); }
"""

CSS = (
    f":root {{ color-scheme: light dark;{_LIGHT} }}"
    + """
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ef; --soft: #9aa5b8; --line: #333b49;
  --back: #14181f; --card: #1b212b; --accent: #7cc0f0; --good: #7fdcb2; --good-bg: #123a2b;
  --over: #ffb284; --over-bg: #47250f; --under: #a4c6fb; --under-bg: #1b2f50; --bad: #ff9db4;
  --bad-bg: #4a1524; --none: #c0c7d4; --none-bg: #2b323e; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 2.5rem 1.5rem 4rem; background: var(--back);
  color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans",
  "DejaVu Sans", sans-serif; }
header { border-bottom: 2px solid var(--ink); padding-bottom: 1.1rem; }
.kicker { margin: 0; color: var(--accent); font-size: .8rem; font-weight: 600;
  letter-spacing: .08em; text-transform: uppercase; }
h1 { margin: .2rem 0 .3rem; font-size: 1.9rem; line-height: 1.2; overflow-wrap: anywhere; }
h2 { margin: 2.4rem 0 .8rem; font-size: 1.2rem; }
.lead { margin: 0; color: var(--soft); }
"""
    + _PARTS
    + """
dl { display: grid; grid-template-columns: max-content 1fr; gap: .35rem 1.1rem; margin: 0; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
@page broad { size: landscape; margin: 10mm; }
@media screen { img { width: min(100%, 54rem); } .verdicts li { align-content: start; } }
@media screen and (min-width: 72rem) { .scroll { position: relative; left: 50%; width: fit-content;
  min-width: 100%; max-width: 96vw; transform: translateX(-50%); } }
@media screen and (max-width: 40rem) { body { padding: 1.25rem .75rem 2.5rem; }
  h1 { font-size: 1.4rem; } .scroll { margin: 0 -.75rem; } table { font-size: .7rem; }
  th, td { padding: .3rem .25rem; white-space: normal; } td { min-width: 3.9rem; }
  td.honest { min-width: 0; font-size: .62rem; }
  th:first-child { width: 5.2rem; min-width: 5.2rem; padding-left: .6rem; }
  tr th.sub { padding-left: 1.2rem; }
  td .badge { padding: 0 .2rem; font-size: .9em; border-radius: .3rem; white-space: normal; }
  .verdicts, dl { grid-template-columns: 1fr; } dd { margin-bottom: .4rem; }
  figure { overflow-x: auto; } img { width: 36rem; max-width: none; padding: .2rem; } }
@media print { :root { color-scheme: light; --ink: #000; --soft: #444; --line: #ccc; --back: #fff;
    --card: #fff; --accent: #000; --good: #0a6b47; --over: #9c3b00; --under: #22508f;
    --bad: #a3123a; --none: #4d5566; --good-bg: #fff; --over-bg: #fff; --under-bg: #fff;
    --bad-bg: #fff; --none-bg: #fff; font-size: 12px; }
  body { max-width: none; padding: 0; font-size: 1rem; } .scroll { overflow: visible; }
  table { font-size: .82rem; } th, td { padding: .15rem .3rem; white-space: normal; }
  th:first-child { position: static; } tr th.sub { padding-left: .9rem; } h2 { break-after: avoid; }
  .badge { padding: 0; } td .badge { font-size: inherit; } .broad { page: broad; }
  .broad table { font-size: .72rem; } tr, li { break-inside: avoid; } }
"""
)

FRAGMENT_CSS = (
    """
.jaxslam { color-scheme: light;"""
    + _LIGHT
    + """
  padding: .2rem 1rem 1rem; background: var(--back); color: var(--ink);
  font: 14px/1.5 system-ui, sans-serif; & * { box-sizing: border-box; }
  summary { cursor: pointer; }
"""
    + _PARTS
    + "figure { margin: 1rem 0; } }"
)
"""Rules nested below one class, with light colours alone: figures are light, too."""
