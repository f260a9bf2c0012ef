// Sensitivity: one panel for each swept key, the metric over it, another key as colour.

const MOST_PANELS = 8;
const MARGIN = { left: 58, right: 12, top: 10, bottom: 44 };
const panels = [];
const colourOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function mark(context, shape, x, y, r) {
  context.beginPath();
  if (shape === "circle") context.arc(x, y, r, 0, 2 * Math.PI);
  else if (shape === "square") context.rect(x - 0.9 * r, y - 0.9 * r, 1.8 * r, 1.8 * r);
  else if (shape === "triangle" || shape === "diamond") {
    context.moveTo(x, y - 1.25 * r);
    context.lineTo(x + 1.15 * r, shape === "diamond" ? y : y + 0.9 * r);
    if (shape === "diamond") context.lineTo(x, y + 1.25 * r);
    context.lineTo(x - 1.15 * r, shape === "diamond" ? y : y + 0.9 * r);
    context.closePath();
  } else {
    const turn = shape === "cross" ? [[-1, -1, 1, 1], [-1, 1, 1, -1]] : [[-1.2, 0, 1.2, 0], [0, -1.2, 0, 1.2]];
    for (const [a, b, c, d] of turn) {
      context.moveTo(x + a * r, y + b * r);
      context.lineTo(x + c * r, y + d * r);
    }
    context.lineWidth = 0.55 * r;
    context.stroke();
    return;
  }
  context.fill();
}

class Panel {
  constructor(key) {
    this.key = key;
    this.points = [];
    this.hovered = -1;
    this.caption = make("figcaption");
    this.canvas = make("canvas", { tabindex: 0, role: "img", "data-key": key.name });
    this.tip = make("div", { class: "tip", role: "status", hidden: true });
    this.legend = make("div", { class: "legend" });
    this.element = make("figure", { class: "panel" }, this.caption, this.canvas, this.legend, this.tip);
    this.canvas.addEventListener("pointermove", (event) => this.hover(this.nearest(event)));
    this.canvas.addEventListener("pointerleave", () => this.hover(-1));
    this.canvas.addEventListener("blur", () => this.hover(-1));
    this.canvas.addEventListener("click", (event) => this.take(this.nearest(event)));
    this.canvas.addEventListener("keydown", (event) => this.typed(event));
  }

  // The colour chosen for all panels, or the first key that is not this panel's own.
  tint() {
    const wish = byId("colour").value;
    if (wish === "none") return null;
    const varying = keys.filter((column) => column.varies && column !== this.key);
    return wish === "auto" ? (varying[0] ?? null) : byName.get(wish);
  }

  draw() {
    const metric = byName.get(state.metric);
    const { key, canvas } = this;
    const rows = state.rows.filter((row) => Number.isFinite(metric.cells[row]) && key.cells[row] !== null && !Number.isNaN(key.cells[row]));
    this.caption.textContent = `${metric.words} over ${key.words}`;
    canvas.dataset.metric = metric.name;
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.font = "12px system-ui, sans-serif";
    this.points = [];
    canvas.setAttribute("aria-label", `${heading(metric)} over ${heading(key)}: ${rows.length} runs`);
    if (!rows.length) {
      this.legend.replaceChildren();
      context.fillStyle = colourOf("--muted");
      context.fillText("No run to draw.", MARGIN.left, height / 2);
      return;
    }
    this.x = keyScale(key, rows);
    this.y = numberScale(rows.map((row) => metric.cells[row]), byId("scale").value, 30);
    const inner = { w: width - MARGIN.left - MARGIN.right, h: height - MARGIN.top - MARGIN.bottom };
    this.px = (value) => MARGIN.left + inner.w * this.x.at(value);
    this.py = (value) => MARGIN.top + inner.h * (1 - this.y.at(value));
    this.points = rows.map((row) => [this.px(key.cells[row]), this.py(metric.cells[row]), row]);
    this.axes(context, width, height, metric);
    const tint = colouring(this.tint(), rows);
    this.medians(context, rows, metric, tint);
    this.dots(context, tint);
    this.explain(tint);
  }

  axes(context, width, height, metric) {
    const [ink, muted, grid] = ["--ink", "--muted", "--grid"].map(colourOf);
    const bottom = height - MARGIN.bottom;
    context.lineWidth = 1;
    context.strokeStyle = grid;
    context.fillStyle = muted;
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const tick of this.y.ticks) {
      const y = Math.round(this.py(tick)) + 0.5;
      context.beginPath();
      context.moveTo(MARGIN.left, y);
      context.lineTo(width - MARGIN.right, y);
      context.stroke();
      context.fillText(short(tick), MARGIN.left - 6, y);
    }
    context.textAlign = "center";
    context.textBaseline = "top";
    let free = -Infinity; // where the last label ended: labels that would touch are left out
    const room = (width - MARGIN.left - MARGIN.right) / this.x.ticks.length;
    for (const tick of this.x.ticks) {
      const x = Math.round(this.px(tick)) + 0.5;
      context.beginPath();
      context.moveTo(x, MARGIN.top);
      context.lineTo(x, bottom);
      context.stroke();
      const text = typeof tick === "number" ? short(tick) : clipped(context, tick, Math.max(60, room - 8));
      const half = context.measureText(text).width / 2;
      const middle = Math.min(x, width - half - 1);
      if (middle - half < free) continue;
      context.fillText(text, middle, bottom + 6);
      free = middle + half + 8;
    }
    context.fillStyle = ink;
    const note = (scale) => (scale.log ? ", log" : "");
    context.fillText(heading(this.key) + note(this.x), MARGIN.left + (width - MARGIN.left - MARGIN.right) / 2, height - 17);
    context.save();
    context.translate(4, MARGIN.top + (bottom - MARGIN.top) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(clipped(context, heading(metric) + note(this.y), bottom - MARGIN.top), 0, 0);
    context.restore();
  }

  // A line through the medians at each value of a numeric key: one for each colour, one for all where the colour is a ramp.
  medians(context, rows, metric, tint) {
    if (!this.key.number || this.x.found.length < 2 || this.x.found.length > 400) return;
    const groups = new Map();
    for (const row of rows) {
      const id = tint.of(row);
      if (!groups.has(id)) groups.set(id, new Map());
      const group = groups.get(id);
      const value = this.key.cells[row];
      if (!group.has(value)) group.set(value, []);
      group.get(value).push(metric.cells[row]);
    }
    for (const [id, group] of groups) {
      context.strokeStyle = tint.column && !tint.kinds.length ? colourOf("--ink") : PALETTE[id];
      context.lineWidth = 1.8;
      context.beginPath();
      this.x.found.filter((value) => group.has(value)).forEach((value, k) => {
        context[k ? "lineTo" : "moveTo"](this.px(value), this.py(median(group.get(value))));
      });
      context.stroke();
    }
  }

  dots(context, tint) {
    const many = this.points.length;
    const radius = many > 2000 ? 2 : many > 300 ? 3 : 4.5;
    context.globalAlpha = many > 2000 ? 0.35 : many > 300 ? 0.6 : 1;
    for (const [x, y, row] of this.points) {
      context.fillStyle = context.strokeStyle = tint.colour(row);
      mark(context, SHAPES[tint.of(row)], x, y, radius);
    }
    context.globalAlpha = 1;
    for (const row of new Set([state.chosen, this.points[this.hovered]?.[2]])) {
      const point = this.points.find((entry) => entry[2] === row);
      if (!point) continue;
      context.strokeStyle = colourOf("--ink");
      context.lineWidth = 2;
      context.beginPath();
      context.arc(point[0], point[1], radius + 4, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  explain(tint) {
    const parts = [];
    if (tint.column) parts.push(make("span", {}, heading(tint.column)));
    tint.kinds.forEach((kind, k) => {
      const swatch = make("canvas", { width: 52, height: 24, "aria-hidden": "true" });
      const context = swatch.getContext("2d");
      context.fillStyle = context.strokeStyle = PALETTE[k];
      context.fillRect(0, 10, 52, 4);
      mark(context, SHAPES[k], 26, 12, 9);
      parts.push(make("span", {}, swatch, String(kind)));
    });
    if (tint.column && !tint.kinds.length) {
      const stops = [0, 0.25, 0.5, 0.75, 1].map(ramp).join(",");
      const [low, high] = [tint.found[0], tint.found[tint.found.length - 1]];
      const bar = make("span", { class: "ramp", style: `background:linear-gradient(90deg,${stops})` });
      parts.push(make("span", {}, short(low), bar, short(high)));
    }
    this.legend.replaceChildren(...parts);
  }

  // The point nearest to the pointer, within reach of a finger; -1 for none.
  nearest(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    let [best, reach] = [-1, 24 ** 2];
    this.points.forEach(([a, b], k) => {
      const gap = (a - x) ** 2 + (b - y) ** 2;
      if (gap < reach) [best, reach] = [k, gap];
    });
    return best;
  }

  hover(k) {
    if (k === this.hovered) return;
    this.hovered = k;
    this.draw();
    this.tip.hidden = k < 0;
    if (k < 0) return;
    const [x, y, row] = this.points[k];
    const told = [byName.get(state.metric), ...keys.filter((column) => column.varies)];
    this.tip.replaceChildren(make("b", {}, names[row]), ...told.map((column) => make("div", {}, `${heading(column)}: ${written(column, row)}`)));
    const width = this.element.clientWidth;
    const left = x > width / 2 ? Math.max(0, x - this.tip.offsetWidth - 14) : Math.min(x + 14, width - this.tip.offsetWidth);
    this.tip.style.left = `${left}px`;
    this.tip.style.top = `${y + this.canvas.offsetTop + 10}px`;
  }

  take(k) {
    if (k >= 0) choose(this.points[k][2]);
  }

  typed(event) {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (event.key === "Enter") this.take(this.hovered);
    if (!step || !this.points.length) return;
    event.preventDefault();
    const order = this.points.map((_, k) => k).sort((a, b) => this.points[a][0] - this.points[b][0] || this.points[b][1] - this.points[a][1]);
    const at = order.indexOf(this.hovered);
    this.hover(order[at < 0 ? 0 : (at + step + order.length) % order.length]);
  }
}

function clipped(context, text, width) {
  let kept = text;
  while (kept.length > 3 && context.measureText(kept).width > width) kept = `${kept.slice(0, -2)}…`;
  return kept;
}

function startPlots() {
  const varying = keys.filter((column) => column.varies);
  panels.push(...varying.slice(0, MOST_PANELS).map((key) => new Panel(key)));
  fill(byId("colour"), [["auto", "another key"], ["none", "one colour"], ...varying.map((key) => [key.name, key.words])], "auto");
  const words = varying.length > MOST_PANELS ? `The first ${MOST_PANELS} of ${varying.length} swept keys are drawn.` : "";
  const none = varying.length ? words : "Nothing was swept: the runs share all their settings.";
  byId("panels").append(...panels.map((panel) => panel.element), ...(none ? [make("p", { class: "hint" }, none)] : []));
  const draw = () => panels.forEach((panel) => panel.draw());
  byId("colour").addEventListener("change", draw);
  byId("scale").addEventListener("change", draw);
  for (const event of ["rows", "metric", "chosen", "theme"]) on(event, draw);
  addEventListener("resize", draw);
  draw();
}
