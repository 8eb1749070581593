/* Makes the report of a campaign one to explore: filters hidden and sorted, values under the
   pointer, zoom in time, light and dark. Without it the page shows its static figures. The data
   stands in the element "curves" (curves.py). Nothing is loaded; names become text nodes alone. */
"use strict";
{
  const data = JSON.parse(document.getElementById("curves").textContent);
  const root = document.documentElement, names = data.filters;
  const [DASHES, HUES] = [["", "7 2.4", "2 2", "8 2 2 2", "12 3"], 6];
  const hidden = new Set();
  const panels = [];
  let order = names.map((_, i) => i), sorted = { key: "", up: true };
  let view = [1, data.steps], picked = null;

  const fill = (node, set, inside) => {
    for (const key in set) node.setAttribute(key, set[key]);
    node.append(...inside);
    return node;
  };
  const make = (tag, set, ...inside) => fill(document.createElement(tag), set, inside);
  const draw = (tag, set, ...inside) =>
    fill(document.createElementNS("http://www.w3.org/2000/svg", tag), set, inside);
  const press = (text, set, act) => {
    const button = make("button", { type: "button", ...set }, text);
    button.addEventListener("click", act);
    return button;
  };
  const visible = () => order.filter((i) => !hidden.has(i));
  const hue = (i) => `var(--c${data.looks[i] % HUES})`;
  const look = (i) => ({ // as in the figures: thirty filters differ in colour and dashes
    stroke: hue(i), "stroke-dasharray": DASHES[data.looks[i] % DASHES.length], fill: "none",
  });
  const swatch = (i) =>
    draw("svg", { class: "swatch", width: 26, height: 8, "aria-hidden": "true" },
      draw("path", { d: "M1 4H25", "stroke-width": 2.2, ...look(i) }));
  const SUPER = { "-": "⁻", ...Object.fromEntries([..."⁰¹²³⁴⁵⁶⁷⁸⁹"].entries()) };
  const said = (value) => {
    if (value === 0) return "0";
    const size = Math.abs(value);
    if (size >= 1e-3 && size < 1e5) return String(+value.toPrecision(4)).replace("-", "−");
    const [digits, power] = value.toExponential(3).split("e");
    const raised = [...power.replace("+", "")].map((c) => SUPER[c]).join("");
    return `${+digits === 1 ? "" : `${+digits}·`}10${raised}`.replace("-", "−");
  };

  /* Scales. */
  const linear = (low, high, parts = 4) => {
    const rough = (high - low) / parts, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((m) => m * power >= rough * 0.999);
    const first = Math.ceil(low / step - 1e-9);
    const ticks = [];
    for (let k = first; k * step <= high * (1 + 1e-9) + 1e-300; k += 1) ticks.push(k * step);
    return { low, high, ticks, share: (v) => (v - low) / (high - low) };
  };
  const logarithmic = (low, high) => {
    const [a, b] = [Math.log10(low), Math.log10(high)], every = Math.ceil((b - a) / 6) || 1;
    const ticks = [];
    for (let e = Math.floor(a); e <= b; e += 1) {
      for (const m of b - a > 2.2 ? [1] : [1, 2, 5]) {
        const v = m * 10 ** e;
        if (v >= low && v <= high && (m > 1 || e % every === 0)) ticks.push(v);
      }
    }
    return { low, high, ticks, share: (v) => (Math.log10(Math.max(v, 1e-300)) - a) / (b - a) };
  };
  /* A curve is one number, an array, or two: the least and the greatest value of several steps. */
  const ends = (curve, j) => (typeof curve === "number" ? [curve, curve]
    : Array.isArray(curve[0]) ? [curve[0][j], curve[1][j]] : [curve[j], curve[j]]);
  const x = (panel, j) => (panel.at ? panel.at[j] : j * data.each + (data.each + 1) / 2);
  const points = (panel) => (panel.at ? panel.at.length : Math.ceil(data.steps / data.each));
  const limits = (panel) => panel.limits ?? (view[0] < view[1] ? view : [view[0] - 0.5, view[0] + 0.5]);
  const inView = (panel) => {
    const [a, b] = limits(panel), found = [];
    for (let j = 0; j < points(panel); j += 1) {
      if (x(panel, j) >= a - data.each && x(panel, j) <= b + data.each) found.push(j);
    }
    return found;
  };
  const spread = (curve, at) => {
    let [low, high] = [Infinity, -Infinity];
    for (const j of at) {
      const [l, h] = ends(curve, j);
      if (l !== null && l < low && l > 0) low = l;
      if (h !== null && h > high) high = h;
    }
    return [low, high];
  };
  const scaleOf = (panel) => {
    if (panel.scale === "unit") return linear(0, 1);
    const at = inView(panel), mine = visible().filter((i) => panel.values[i]);
    const each = mine.map((i) => spread(panel.values[i], at)).filter((e) => e[1] > -Infinity);
    const tops = each.map((e) => e[1]).sort((p, q) => p - q);
    const fixed = [];
    const band = panel.bands[panel.band];
    if (band) fixed.push(spread(band[0], at), spread(band[1], at));
    if (panel.reference) fixed.push(spread(panel.reference.values, at));
    const low = Math.min(...[...each, ...fixed].map((e) => e[0]).filter((v) => v > 0), 1e300);
    const rest = Math.max(...fixed.map((e) => e[1]), 0);
    let high = Math.max(rest, ...tops);
    if (panel.scale === "symmetric") {
      const far = mine.flatMap((i) => panel.values[i]).filter((v) => v !== null).map(Math.abs);
      high = 1.1 * Math.max(1.5 * rest, ...far, 1e-3);
      return linear(-high, high);
    }
    if (!(high > 0) || low >= 1e300) return linear(0, 1);
    if (panel.scale === "floor") {
      return { ...logarithmic(panel.floor, Math.max(3 * high, 1)), strip: 0.2 };
    }
    const log = panel.log ?? (panel.scale === "log" && high > 10 * low);
    panel.isLog = log;
    if (panel.scale === "log" && mine.length > 1) high = Math.min(high, Math.max(100 * panel.honest, 3 * rest));
    else if (panel.scale === "zero" && !log && tops.length) { // one filter alone does not set the scale
      const limit = 3 * tops[Math.floor((tops.length - 1) / 2)];
      high = Math.max(rest, ...tops.filter((v) => v <= limit));
    }
    const room = 0.06 * (high - low) || 0.1 * high;
    if (!log && panel.scale === "log") return linear(Math.max(low - room, 0), high + room);
    if (!log) return linear(0, 1.06 * high);
    const least = Math.max(low, 1e-4 * high), factor = Math.max((high / least) ** 0.06, 1.01);
    return logarithmic(least / factor, high * factor);
  };

  /* A panel: an SVG with axes, the band, the curves; a cursor; a list of values. */
  const EDGE = { left: 54, right: 20, top: 8, bottom: 36 };
  let numbered = 0;
  const build = (chart, panel) => {
    const clip = `clip${(numbered += 1)}`;
    const keys = "Arrow keys move the cursor and choose a filter"
      + (panel.limits ? "." : "; + and − zoom, 0 shows all steps.");
    const svg = draw("svg", { tabindex: 0, role: "img", class: "plot",
      "aria-label": `${panel.title} against ${chart.x}. ${keys}` });
    const list = make("div", { class: "values", role: "status" });
    const beyond = make("span", { class: "beyond" });
    const head = make("p", { class: "panel-head" }, make("strong", {}, panel.title), beyond);
    if (panel.scale === "log" || panel.scale === "zero") {
      panel.button = press("log", { class: "small", "aria-pressed": "false", title: "logarithmic scale" }, () => {
        panel.log = !panel.isLog;
        redraw(panel);
      });
      head.append(panel.button);
    }
    const node = make("div", { class: "panel" }, head, svg, list);
    let start = null;
    const where = (event) => {
      const box = svg.getBoundingClientRect();
      const [a, b] = limits(panel);
      const share = (event.clientX - box.left - EDGE.left) / (panel.width - EDGE.left - EDGE.right);
      return [a + Math.min(Math.max(share, 0), 1) * (b - a), event.clientY - box.top];
    };
    svg.addEventListener("pointerdown", (event) => {
      if (panel.limits || event.pointerType !== "mouse" || event.button) return;
      start = where(event)[0];
      svg.setPointerCapture?.(event.pointerId);
    });
    svg.addEventListener("pointermove", (event) => {
      const [at, height] = where(event);
      if (start !== null) {
        const [l, r] = [panel.px(Math.min(start, at)), panel.px(Math.max(start, at))];
        panel.over.replaceChildren(draw("rect", { class: "zoom", x: l, width: r - l,
          y: EDGE.top, height: panel.height - EDGE.top - EDGE.bottom }));
        return;
      }
      point(panel, nearest(panel, at), height);
    });
    svg.addEventListener("pointerup", (event) => {
      const from = start, to = where(event)[0];
      start = null;
      if (from !== null && Math.abs(panel.px(to) - panel.px(from)) > 6) zoom(Math.min(from, to), Math.max(from, to));
      else if (from !== null) point(panel, nearest(panel, to), where(event)[1]);
    });
    svg.addEventListener("pointercancel", () => { start = null; });
    svg.addEventListener("pointerleave", () => { if (start === null && document.activeElement !== svg) leave(); });
    svg.addEventListener("blur", leave);
    svg.addEventListener("dblclick", () => panel.limits || zoom(1, data.steps));
    svg.addEventListener("focus", () => { if (panel.cursor === undefined) point(panel, inView(panel)[0]); });
    svg.addEventListener("keydown", (event) => {
      const at = inView(panel), here = Math.max(at.indexOf(panel.cursor), 0), leap = event.shiftKey ? 10 : 1;
      const mine = visible().filter((i) => panel.values[i]);
      const next = (by) => mine[(mine.indexOf(picked) + by + mine.length) % mine.length] ?? null;
      const around = (by) => { // the cursor stays where it is
        if (panel.limits) return;
        const here = panel.cursor === undefined ? undefined : x(panel, panel.cursor);
        closer(by, here);
        if (here !== undefined) point(panel, nearest(panel, here));
      };
      const acts = {
        ArrowLeft: () => point(panel, at[Math.max(here - leap, 0)]),
        ArrowRight: () => point(panel, at[Math.min(here + leap, at.length - 1)]),
        Home: () => point(panel, at[0]),
        End: () => point(panel, at[at.length - 1]),
        ArrowDown: () => { pick(next(1)); point(panel, panel.cursor); },
        ArrowUp: () => { pick(next(-1)); point(panel, panel.cursor); },
        "+": () => around(0.5),
        "=": () => around(0.5),
        "-": () => around(2),
        0: () => panel.limits || zoom(1, data.steps),
        Escape: leave,
      };
      if (!acts[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      acts[event.key]();
    });
    Object.assign(panel, { svg, list, beyond, node, clip, x: chart.x });
    panels.push(panel);
    return node;
  };
  const nearest = (panel, at) => inView(panel).reduce(
    (best, j) => (Math.abs(x(panel, j) - at) < Math.abs(x(panel, best) - at) ? j : best), inView(panel)[0]);

  const redraw = (panel) => {
    const width = (panel.width = panel.svg.clientWidth), height = (panel.height = panel.svg.clientHeight);
    if (!width) return; // not shown, as on paper
    const [a, b] = limits(panel), scale = scaleOf(panel), at = inView(panel);
    const [right, bottom] = [width - EDGE.right, height - EDGE.bottom];
    const px = (v) => EDGE.left + ((v - a) / (b - a || 1)) * (right - EDGE.left);
    const base = bottom - (scale.strip ?? 0) * (bottom - EDGE.top);
    const mine = visible().filter((i) => panel.values[i]);
    const py = (v, i) => {
      if (scale.strip && v <= scale.low) { // too little to be on the axis: a height for each filter
        return base + ((bottom - base) * (mine.indexOf(i) + 1)) / (mine.length + 1);
      }
      return base - Math.max(Math.min(scale.share(v), 1.2), -0.2) * (base - EDGE.top);
    };
    const lines = draw("g", { "clip-path": `url(#${panel.clip})` });
    const path = (curve, i) => {
      let [d, pen] = ["", "M"];
      for (const j of at) {
        const both = ends(curve, j);
        if (both[0] === null) { pen = "M"; continue; }
        for (const v of both[0] === both[1] ? [both[0]] : both) {
          d += `${pen}${px(x(panel, j)).toFixed(1)} ${py(v, i).toFixed(1)}`;
          pen = "L";
        }
      }
      return d;
    };
    const drawn = panel.bands[panel.band];
    if (drawn) {
      const there = at.filter((j) => ends(drawn[0], j)[0] !== null);
      const side = (k) => there.map((j) => `${px(x(panel, j)).toFixed(1)} ${py(ends(drawn[k], j)[k]).toFixed(1)}`);
      if (there.length === 1) {
        const edges = [0, 1].map((k) => py(ends(drawn[k], there[0])[k]));
        lines.append(draw("rect", { class: "band", x: EDGE.left, width: right - EDGE.left, y: edges[1], height: edges[0] - edges[1] }));
      } else if (there.length) lines.append(draw("path", { class: "band", d: `M${[...side(1), ...side(0).reverse()].join("L")}Z` }));
    }
    if (panel.reference) lines.append(draw("path", { class: "reference", d: path(panel.reference.values) }));
    for (const i of [...mine].sort((p, q) => (p === picked) - (q === picked))) {
      const known = at.filter((j) => ends(panel.values[i], j)[0] !== null);
      lines.append(draw("path", { class: i === picked ? "curve on" : "curve", "data-filter": i, ...look(i), d: path(panel.values[i], i) }));
      if (known.length === 1) {
        const j = known[0];
        lines.append(draw("circle", { cx: px(x(panel, j)), cy: py(ends(panel.values[i], j)[1], i), r: 3, fill: hue(i) }));
      }
    }
    const grid = draw("g", { class: "axes" });
    for (const v of scale.ticks) {
      const y = py(v).toFixed(1);
      if (scale.strip && v <= scale.low) continue;
      grid.append(draw("path", { d: `M${EDGE.left} ${y}H${right}` }),
        draw("text", { x: EDGE.left - 6, y, "text-anchor": "end", dy: "0.32em" }, said(v)));
    }
    if (scale.strip) {
      grid.append(draw("rect", { class: "strip", x: EDGE.left, y: base, width: right - EDGE.left, height: bottom - base }),
        draw("text", { x: EDGE.left - 6, y: (base + bottom) / 2, "text-anchor": "end", dy: "0.32em" }, `< ${said(scale.low)}`));
    }
    const across = panel.at && panel.scale !== "unit" ? panel.at : linear(a, b > a ? b : a + 1, width / 110).ticks;
    for (const v of across) {
      if (v < a || v > b || (!panel.at && !Number.isInteger(v))) continue;
      grid.append(draw("text", { x: px(v), y: bottom + 15, "text-anchor": "middle" }, said(v)));
    }
    grid.append(draw("path", { class: "line", d: `M${EDGE.left} ${EDGE.top}V${bottom}H${right}` }),
      draw("text", { x: (EDGE.left + right) / 2, y: height - 4, "text-anchor": "middle" }, panel.x));
    panel.over = draw("g", { class: "over" });
    panel.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    panel.svg.replaceChildren(
      draw("clipPath", { id: panel.clip }, draw("rect", { x: EDGE.left, y: EDGE.top - 2, width: right - EDGE.left, height: bottom - EDGE.top + 4 })),
      grid, lines, panel.over);
    panel.svg.classList.toggle("chosen", picked !== null);
    panel.high = scale.high * 1.001;
    const out = mine.filter((i) => spread(panel.values[i], at)[1] > panel.high);
    panel.beyond.textContent = out.length ? `▲ beyond the scale: ${out.map((i) => names[i]).join(", ")}` : "";
    panel.button?.setAttribute("aria-pressed", String(Boolean(panel.isLog)));
    Object.assign(panel, { px, py });
  };
  const everything = () => panels.forEach(redraw);

  /* The cursor. */
  const leave = () => {
    for (const panel of panels) {
      panel.over?.replaceChildren();
      panel.list.replaceChildren();
      panel.list.classList.remove("there");
      delete panel.cursor;
    }
    pick(null);
  };
  const point = (panel, j, height) => {
    if (j === undefined) return;
    const near = visible().filter((i) => panel.values[i] && ends(panel.values[i], j)[0] !== null);
    if (height !== undefined) {
      const far = (i) => Math.min(...ends(panel.values[i], j).map((v) => Math.abs(panel.py(v, i) - height)));
      pick(near.length ? near.reduce((best, i) => (far(i) < far(best) ? i : best)) : null);
    }
    for (const other of panels) {
      other.over?.replaceChildren();
      other.list.classList.remove("there");
      if (other !== panel && (other.limits || panel.limits)) continue;
      if (!other.px) continue;
      other.over.append(draw("path", { class: "cursor", d: `M${other.px(x(other, j))} ${EDGE.top}V${other.height - EDGE.bottom}` }));
      for (const i of visible().filter((i) => other.values[i])) {
        for (const v of new Set(ends(other.values[i], j))) {
          if (v === null || v > other.high) continue;
          other.over.append(draw("circle", { cx: other.px(x(other, j)), cy: other.py(v, i), r: i === picked ? 4.5 : 2.5, fill: hue(i) }));
        }
      }
    }
    panel.cursor = j;
    panel.list.replaceChildren(...values(panel, j, near));
    panel.list.classList.add("there");
    panel.list.classList.toggle("left", panel.px(x(panel, j)) > panel.width / 2);
  };
  const range = (low, high) => (low === high ? said(low) : `${said(low)} – ${said(high)}`);
  const values = (panel, j, there) => {
    const last = Math.min((j + 1) * data.each, data.steps), first = j * data.each + 1;
    const title = panel.at ? `${panel.x} ${said(panel.at[j])}`
      : first === last ? `step ${last}` : `steps ${first} – ${last}, least – greatest`;
    const rows = [...there].sort((p, q) => ends(panel.values[q], j)[1] - ends(panel.values[p], j)[1]);
    const out = [make("p", { class: "when" }, title)];
    for (const i of rows) {
      out.push(make("p", { class: i === picked ? "value on" : "value", "data-filter": i },
        swatch(i), make("span", {}, names[i]), make("b", {}, range(...ends(panel.values[i], j)))));
      const band = panel.bands[panel.banded[i]];
      if (i !== picked || !band || band[0] === undefined || ends(band[0], j)[0] === null) continue;
      const [low, high] = [ends(band[0], j)[0], ends(band[1], j)[1]], [l, h] = ends(panel.values[i], j);
      const place = l > high ? "above" : h < low ? "below" : l < low || h > high ? "partly in" : "in";
      out.push(make("p", { class: "in-band" }, `${place} its 95 % band, ${said(low)} – ${said(high)}`));
    }
    if (panel.reference && ends(panel.reference.values, j)[0] !== null) {
      out.push(make("p", { class: "in-band" }, `${panel.reference.label}: ${range(...ends(panel.reference.values, j))}`));
    }
    return out;
  };
  const pick = (i) => {
    if (i === picked) return;
    picked = i;
    for (const panel of panels) {
      panel.svg.classList.toggle("chosen", i !== null);
      for (const line of panel.svg.querySelectorAll(".curve")) line.classList.toggle("on", +line.dataset.filter === i);
    }
  };

  /* Zoom in time. */
  const box = (label) => make("input", { type: "number", min: 1, max: data.steps, "aria-label": label });
  const [from, to] = [box("first step shown"), box("last step shown")];
  const zoom = (a, b) => {
    const least = Math.min(data.steps - 1, 4 * data.each), wide = Math.min(Math.max(b - a, least), data.steps - 1);
    a = Math.round(Math.min(Math.max(1, (a + b - wide) / 2), data.steps - wide));
    view = [a, Math.min(Math.round(a + wide), data.steps)];
    [from.value, to.value] = view;
    leave();
    panels.filter((panel) => !panel.limits).forEach(redraw);
  };
  const closer = (by, middle = (view[0] + view[1]) / 2) =>
    zoom(middle - by * (middle - view[0]), middle + by * (view[1] - middle));
  for (const each of [from, to]) {
    each.addEventListener("change", () => {
      const [a, b] = [+from.value, +to.value];
      if (a >= 1 && b > a) zoom(a, b);
      else zoom(...view);
    });
  }

  /* Filters: hidden, sorted. */
  const rows = [...document.querySelectorAll("main table tr:not(.group)")].map((row) => ({
    row, head: row.cells[0], cells: [...row.cells].slice(2),
  }));
  const cards = [...document.querySelectorAll(".verdicts > li")];
  const numbersOf = ({ cells }) => cells.map((cell) => (cell.dataset.v === undefined ? NaN : +cell.dataset.v));
  const chips = names.map((name, i) => {
    const chip = press(swatch(i), { class: "chip", "aria-pressed": "true", title: "hide or show; double click: this one alone" }, () => {
      hidden.delete(i) || hidden.add(i);
      show();
    });
    chip.append(name);
    chip.addEventListener("dblclick", () => {
      names.forEach((_, k) => hidden.add(k));
      hidden.delete(i);
      show();
    });
    chip.addEventListener("pointerenter", () => hidden.has(i) || pick(i));
    chip.addEventListener("pointerleave", () => pick(null));
    return chip;
  });
  const show = () => {
    names.forEach((_, i) => {
      const off = hidden.has(i);
      chips[i].setAttribute("aria-pressed", String(!off));
      for (const node of [cards[i], ...rows.map(({ cells }) => cells[i])]) node?.classList.toggle("off", off);
    });
    leave();
    everything();
  };
  const keys = rows.filter((row) => numbersOf(row).some((v) => !isNaN(v)));
  const choice = make("select", { "aria-label": "sort filters by" }, make("option", { value: "" }, "as given"), make("option", { value: "name" }, "name"),
    ...keys.map(({ head }, k) => make("option", { value: k }, head.textContent)));
  const turn = press("↑", { class: "small" }, () => sort(sorted.key, !sorted.up));
  const sort = (key, up) => {
    sorted = { key: String(key), up };
    order = names.map((_, i) => i);
    const by = key === "" ? order : key === "name" ? null : numbersOf(keys[key]);
    order.sort((p, q) => {
      if (!by) return (up ? 1 : -1) * names[p].localeCompare(names[q]);
      if (isNaN(by[p]) || isNaN(by[q])) return isNaN(by[p]) - isNaN(by[q]); // without a value: last
      return (up ? 1 : -1) * (by[p] - by[q]);
    });
    for (const { row, cells } of rows) row.append(...order.map((i) => cells[i]));
    cards[0]?.parentNode.append(...order.map((i) => cards[i]));
    chipBox.append(...order.map((i) => chips[i]));
    choice.value = sorted.key;
    turn.textContent = up ? "↑" : "↓";
    turn.setAttribute("aria-label", up ? "ascending; descending instead" : "descending; ascending instead");
    keys.forEach(({ head }, k) => {
      if (sorted.key === String(k)) head.setAttribute("aria-sort", up ? "ascending" : "descending");
      else head.removeAttribute("aria-sort");
    });
  };
  choice.addEventListener("change", () => sort(choice.value, true));
  keys.forEach(({ head }, k) => {
    const label = head.textContent;
    head.replaceChildren(press(label, { class: "sort", title: `sort filters by ${label}` }, () =>
      sort(k, sorted.key === String(k) ? !sorted.up : true)));
  });

  /* Light and dark. */
  const THEMES = ["auto", "light", "dark"];
  const theme = press("", { class: "theme" }, () => {
    dress(THEMES[(THEMES.indexOf(root.dataset.theme ?? "auto") + 1) % THEMES.length]);
  });
  const dress = (name) => {
    if (name === "auto") delete root.dataset.theme;
    else root.dataset.theme = name;
    theme.textContent = `colours: ${name}`;
    try { localStorage.setItem("jaxslam-theme", name); } catch { /* not kept */ }
  };

  /* All together. */
  const chipBox = make("div", { class: "chips", role: "group", "aria-label": "filters" });
  const all = (on) => () => {
    names.forEach((_, i) => (on ? hidden.delete(i) : hidden.add(i)));
    show();
  };
  const tools = make("div", { class: "tools", role: "region", "aria-label": "filters and steps shown" }, chipBox,
    make("div", { class: "knobs" },
      press("all", { class: "small", title: "show all filters" }, all(true)),
      press("none", { class: "small", title: "hide all filters" }, all(false)),
      make("span", { class: "knob" }, "sort by ", choice, turn),
      make("span", { class: "knob", role: "group", "aria-label": "steps shown" }, "steps ", from, " to ", to,
        press("+", { class: "small", "aria-label": "zoom in" }, () => closer(0.5)),
        press("−", { class: "small", "aria-label": "zoom out" }, () => closer(2)),
        press("all", { class: "small", "aria-label": "show all steps" }, () => zoom(1, data.steps)))));
  document.querySelector("main").prepend(tools);
  document.querySelector("header").append(theme);
  for (const chart of data.charts) {
    const figure = document.querySelector(`figure[data-chart="${chart.figure}"]`);
    if (!figure) continue;
    const image = figure.querySelector("img");
    image.classList.add("static");
    image.before(make("div", { class: `live${chart.beside ? " beside" : ""}` }, ...chart.panels.map((panel) => build(chart, panel))));
  }
  let kept = "auto";
  try { kept = localStorage.getItem("jaxslam-theme") ?? "auto"; } catch { /* none is kept */ }
  dress(THEMES.includes(kept) ? kept : "auto");
  sort("", true);
  zoom(1, data.steps);
  show();
  let wide = root.clientWidth;
  new ResizeObserver(() => {
    if (root.clientWidth === wide) return; // only the height has changed
    wide = root.clientWidth;
    everything();
  }).observe(root);
}
