"use strict";
// Every panel is an SVG as wide as the page; all are drawn anew at each zoom, with the least and the greatest
// value of each pixel column.
const plot = JSON.parse(document.getElementById("data").textContent);
const LEFT = 58, RIGHT = 10, TOP = 6, AXIS = 20;
let view = plot.span, at = null, dragged = null;

function add(parent, name, attributes = {}, text = "") {
  const svg = name === "svg" || parent.namespaceURI.endsWith("svg");
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  made.textContent = text;
  return parent.appendChild(made);
}

// The place of the first time that is not before t.
function find(times, t) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < t) low = middle + 1; else high = middle;
  }
  return low;
}

function ticks(low, high, most) {
  const rough = (high - low) / Math.max(1, most), unit = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * unit).find((item) => item >= rough * (1 - 1e-9));
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + step * 1e-9; n++) {
    const value = n * step, wide = Math.abs(value) >= 1e7 || decimals > 5;
    found.push([value, wide ? String(Number(value.toPrecision(10))) : (value || 0).toFixed(decimals)]);
  }
  return found;
}

const root = document.getElementById("plot");
const bar = add(root, "div", { class: "bar" });
for (const [words, act] of [["−", () => zoom(2)], ["+", () => zoom(0.5)], ["←", () => move(-0.25)],
  ["→", () => move(0.25)], ["all", () => show(...plot.span)]]) add(bar, "button", {}, words).onclick = act;
const told = add(bar, "span", { class: "dim" });

const panels = plot.panels.map((panel) => {
  add(root, "h2", {}, panel.heading);
  const legend = add(root, "div", { class: "legend" });
  for (const line of panel.lines) {
    const button = add(legend, "button", { "aria-pressed": true });
    const key = add(button, "svg", { viewBox: "0 0 26 8" });
    add(key, "path", { class: "line", d: "M0 4h26", style: `stroke:${line.colour}`, "stroke-dasharray": line.dashes });
    add(button, "span", {}, line.label);
    line.told = add(button, "span");
    button.onclick = () => {
      line.hidden = !line.hidden;
      button.setAttribute("aria-pressed", !line.hidden);
      draw();
    };
  }
  return { ...panel, svg: add(root, "svg", { class: panel.zero ? "beneath" : "" }) };
});
const strips = [];
if (plot.events !== null) {
  add(root, "h2", {}, plot.events);
  plot.recordings.forEach((name, place) => {
    if (plot.recordings.length > 1) add(root, "p", { class: "dim" }, name);
    strips.push({ marks: plot.marks.filter((mark) => mark[1] === place), svg: add(root, "svg", { class: "events" }) });
  });
}
const news = add(root, "p", { class: "news" });
const axis = add(root, "svg", { class: "events" });

const across = (width) => width - LEFT - RIGHT;
const x = (t, width) => LEFT + (t - view[0]) / (view[1] - view[0]) * across(width);

function range(panel) {
  let low = panel.zero ? 0 : Infinity, high = panel.zero ? 0 : -Infinity;
  for (const line of panel.lines) {
    if (line.hidden) continue;
    for (let n = Math.max(0, find(line.t, view[0]) - 1); n < line.t.length; n++) {
      low = Math.min(low, line.v[n]);
      high = Math.max(high, line.v[n]);
      if (line.t[n] > view[1]) break;
    }
  }
  if (low > high) return [0, 1];
  const room = (high - low) * 0.05 || Math.abs(high) * 0.05 || 1;
  return [panel.zero && !low ? 0 : low - room, high + room];
}

// The way of a line: of each pixel column the least and the greatest value, in their order.
function points(line, width) {
  const found = [], last = Math.min(line.t.length - 1, find(line.t, view[1]));
  for (let n = Math.max(0, find(line.t, view[0]) - 1); n <= last;) {
    const column = Math.floor(x(line.t[n], width));
    let low = n, high = n;
    for (; n <= last && Math.floor(x(line.t[n], width)) === column; n++) {
      if (line.v[n] < line.v[low]) low = n;
      if (line.v[n] > line.v[high]) high = n;
    }
    found.push(Math.min(low, high));
    if (low !== high) found.push(Math.max(low, high));
  }
  return found;
}

function drawPanel(panel) {
  const svg = panel.svg, width = svg.clientWidth, height = svg.clientHeight, [low, high] = range(panel);
  const y = (value) => TOP + (high - value) / (high - low) * (height - 2 * TOP);
  svg.replaceChildren();
  for (const [value, text] of ticks(low, high, height / 40)) {
    add(svg, "line", { class: "rule", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) });
    add(svg, "text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }, text);
  }
  for (const [value] of ticks(...view, width / 110))
    add(svg, "line", { class: "rule", x1: x(value, width), x2: x(value, width), y1: TOP, y2: height - TOP });
  const inside = add(svg, "svg", { x: LEFT, width: across(width), height, viewBox: `${LEFT} 0 ${across(width)} ${height}` });
  inside.style.height = `${height}px`;
  for (const line of panel.lines) {
    if (line.hidden) continue;
    const found = points(line, width), place = (n) => `${x(line.t[n], width).toFixed(1)} ${y(line.v[n]).toFixed(1)}`;
    if (!found.length) continue;
    add(inside, "path", { class: "line", style: `stroke:${line.colour}`, "stroke-dasharray": line.dashes, d: `M${found.map(place).join("L")}` });
    if (!panel.zero && found.length < width / 10)
      add(inside, "path", { class: "dots", style: `stroke:${line.colour}`, d: found.map((n) => `M${place(n)}h0`).join("") });
  }
  overlay(svg, width, height);
}

function overlay(svg, width, height) {
  svg.cursorLine = add(svg, "line", { class: "cursor", y1: 0, y2: height, visibility: "hidden" });
  svg.zoomBox = add(svg, "rect", { class: "zoom", y: 0, height, visibility: "hidden" });
}

function draw() {
  if (axis.clientWidth <= LEFT + RIGHT) return; // not laid out yet; the observer calls again
  panels.forEach(drawPanel);
  for (const { svg, marks } of strips) {
    const width = svg.clientWidth, height = svg.clientHeight;
    svg.replaceChildren();
    add(svg, "line", { class: "rule", x1: LEFT, x2: width - RIGHT, y1: height - 2, y2: height - 2 });
    for (const [t, , severe] of marks) {
      if (t < view[0] || t > view[1]) continue;
      add(svg, "line", { class: severe ? "event severe" : "event", x1: x(t, width), x2: x(t, width), y1: severe ? 2 : 12, y2: height - 2 });
    }
    overlay(svg, width, height);
  }
  const width = axis.clientWidth;
  axis.replaceChildren();
  for (const [value, text] of ticks(...view, width / 110)) add(axis, "text", { x: x(value, width), y: 12, "text-anchor": "middle" }, text);
  add(axis, "text", { x: width - RIGHT, y: 30, "text-anchor": "end" }, plot.axis);
  point();
}

// Move the cursor of all panels, and say the values beside it.
function point() {
  told.textContent = at === null ? "" : `${at.toFixed(6)} s`;
  for (const svg of all) {
    const place = at === null ? 0 : x(at, svg.clientWidth);
    svg.cursorLine.setAttribute("visibility", at === null ? "hidden" : "visible");
    svg.cursorLine.setAttribute("x1", place);
    svg.cursorLine.setAttribute("x2", place);
    svg.zoomBox.setAttribute("visibility", dragged === null ? "hidden" : "visible");
    if (dragged === null) continue;
    const begin = x(Math.min(dragged, at), svg.clientWidth);
    svg.zoomBox.setAttribute("x", begin);
    svg.zoomBox.setAttribute("width", Math.max(0, x(Math.max(dragged, at), svg.clientWidth) - begin));
  }
  for (const panel of panels) for (const line of panel.lines) {
    let n = at === null ? -1 : find(line.t, at);
    if (n > 0 && (n === line.t.length || at - line.t[n - 1] < line.t[n] - at)) n--;
    line.told.textContent = n >= 0 && line.t.length ? ` = ${Number(line.v[n].toPrecision(6))}` : "";
  }
  news.textContent = "";
  if (at === null) return;
  const near = (view[1] - view[0]) / across(root.clientWidth) * 6;
  const close = plot.marks.filter((mark) => Math.abs(mark[0] - at) < near).map((mark) => `${mark[0].toFixed(3)} s ${mark[3]}`);
  news.textContent = close.slice(0, 3).join(" · ") + (close.length > 3 ? ` · ${close.length - 3} more` : "");
}

function show(begin, end) {
  const least = (plot.span[1] - plot.span[0]) * 1e-6;
  if (end - begin < least) return;
  view = [Math.max(plot.span[0], begin), Math.min(plot.span[1], end)];
  draw();
}

function zoom(factor) {
  const middle = at === null ? (view[0] + view[1]) / 2 : at;
  show(middle - (middle - view[0]) * factor, middle + (view[1] - middle) * factor);
}

function move(share) {
  const by = Math.max(plot.span[0] - view[0], Math.min(plot.span[1] - view[1], share * (view[1] - view[0])));
  show(view[0] + by, view[1] + by);
}

const all = [...panels, ...strips].map((item) => item.svg);
for (const svg of all) {
  const time = (event) => {
    const box = svg.getBoundingClientRect(), share = (event.clientX - box.left - LEFT) / across(box.width);
    return view[0] + Math.max(0, Math.min(1, share)) * (view[1] - view[0]);
  };
  svg.onmousedown = (event) => event.preventDefault(); // no text is selected: the browser would drag it away next time
  svg.onpointermove = (event) => { at = time(event); point(); };
  svg.onpointerleave = () => { if (dragged === null) { at = null; point(); } };
  svg.onpointerdown = (event) => { dragged = at = time(event); svg.setPointerCapture(event.pointerId); };
  svg.onpointercancel = () => { dragged = null; point(); };
  svg.onpointerup = (event) => {
    const from = dragged, to = time(event);
    dragged = null;
    if (from !== null && Math.abs(to - from) > (view[1] - view[0]) * 0.01) show(Math.min(from, to), Math.max(from, to));
    else point();
  };
  svg.ondblclick = () => show(...plot.span);
}
document.onkeydown = (event) => {
  const act = { "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), ArrowLeft: () => move(-0.25),
    ArrowRight: () => move(0.25), 0: () => show(...plot.span) }[event.key];
  if (act && !event.ctrlKey && !event.metaKey && !event.altKey) { act(); event.preventDefault(); }
};
new ResizeObserver(draw).observe(root);
draw();
