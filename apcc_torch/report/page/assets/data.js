// The runs as columns, what the reader has chosen, and how numbers are written.

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const columns = data.columns;
const byName = new Map(columns.map((column) => [column.name, column]));
const total = columns[0].cells.length;
const everyRow = Array.from({ length: total }, (_, row) => row);
const names = byName.get("run").cells;
const statuses = byName.get("status").cells;
const keys = columns.filter((column) => column.kind === "key");
const metrics = columns.filter((column) => column.kind === "metric" && column.cells.some((cell) => cell !== null));

for (const column of columns) {
  if (!column.number) continue;
  // JSON has no word for what is not finite: texts stand for it. A missing number is NaN too, but is written as a dash.
  column.missing = column.cells.map((cell) => cell === null);
  column.cells = Float64Array.from(column.cells, (cell) => (cell === null ? NaN : Number(cell)));
  column.decimals = column.kind === "metric" ? decimalsOf(column.cells) : null;
}

const state = {
  metric: data.metric,
  descending: data.descending,
  rows: everyRow, // those the filters let through
  order: everyRow, // the same, sorted as the table is
  chosen: 0,
  limits: [], // {column, most, value}: what a run must keep to
};
const listeners = { rows: [], metric: [], chosen: [], theme: [] };
const on = (event, action) => listeners[event].push(action);
const tell = (event) => listeners[event].forEach((action) => action());

// Decimals that show four digits of the column's usual size; null where sizes differ too much for one answer.
function decimalsOf(cells) {
  const sizes = Array.from(cells, Math.abs).filter((size) => size > 0 && Number.isFinite(size)).sort((a, b) => a - b);
  if (!sizes.length || cells.every((cell) => !Number.isFinite(cell) || Number.isInteger(cell))) return null;
  const [low, high] = [sizes[Math.floor(sizes.length * 0.02)], sizes[Math.floor(sizes.length * 0.98)]];
  if (high / low > 1e4) return null;
  return Math.max(0, Math.min(8, 3 - Math.floor(Math.log10(high))));
}

function short(value) {
  if (Number.isInteger(value) && Math.abs(value) < 1e7) return String(value);
  const size = Math.abs(value);
  return size >= 1e7 || size < 1e-4 ? value.toExponential(2) : String(Number(value.toPrecision(4)));
}

function written(column, row) {
  const value = column.cells[row];
  if (!column.number) return value === null || value === "" ? "–" : value;
  if (column.missing[row]) return "–";
  if (!Number.isFinite(value)) return String(value);
  if (column.kind === "key") return String(Number(value.toPrecision(6)));
  if (column.decimals === null) return short(value);
  const text = value.toFixed(column.decimals);
  return Number(text) === 0 && value !== 0 ? short(value) : text;
}

const heading = (column) => column.words + (column.unit ? ` (${column.unit})` : "");

function distinct(column, rows) {
  const found = [...new Set(rows.map((row) => column.cells[row]))].filter((v) => v !== null && !Number.isNaN(v));
  return column.number ? found.sort((a, b) => a - b) : found.sort(new Intl.Collator("en", { numeric: true }).compare);
}

const signOf = (limit) => (limit.most ? "≤" : "≥");
const keeps = (limit, row) => (limit.most ? limit.column.cells[row] <= limit.value : limit.column.cells[row] >= limit.value);

// How far behind a row stands, and why: 0 it keeps all limits; 1 it does not; 2 it never arrives; 3 it diverged.
function standing(row) {
  const { level, why } = data.standings[row];
  if (level) return { level: level + 1, why };
  const broken = state.limits.filter((limit) => !keeps(limit, row));
  const told = broken.map((limit) => `its ${limit.column.words} is ${written(limit.column, row)} ${limit.column.unit}`.trim() + `, not ${signOf(limit)} ${short(limit.value)}`);
  return { level: broken.length ? 1 : 0, why: told.join("; ") };
}

// Complete rows by the page's metric, best first, behind each other as they stand; what is not finite comes last.
function ranked(rows) {
  const cells = byName.get(state.metric).cells;
  const sign = state.descending ? -1 : 1;
  const place = (row) => (Number.isFinite(cells[row]) ? sign * cells[row] : Infinity);
  const complete = rows.filter((row) => statuses[row] === "complete");
  const level = new Map(complete.map((row) => [row, standing(row).level]));
  return complete.sort((a, b) => level.get(a) - level.get(b) || place(a) - place(b) || a - b);
}

function median(values) {
  const sorted = values.slice().sort((a, b) => a - b);
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

// make("td", {class: "number"}, "1.2"): an element with attributes and children; text is never taken for HTML.
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

// A long key may break after its dots and underscores.
const breakable = (words) => words.split(/(?<=[._/])/).flatMap((part, k) => (k ? [make("wbr"), part] : [part]));

// What heads a row of a table of facts: the column's words and its unit.
function rowHead(column) {
  const unit = column.unit ? [" ", make("span", { class: "unit" }, column.unit)] : [];
  return make("th", { scope: "row" }, ...breakable(column.words), ...unit);
}

function fill(select, options, chosen) {
  select.replaceChildren(...options.map(([value, text]) => make("option", { value, selected: value === chosen }, text)));
}

function choose(row) {
  state.chosen = row;
  tell("chosen");
}
