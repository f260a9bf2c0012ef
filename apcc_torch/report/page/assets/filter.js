// Filters: a text over all settings and names, and an expression for each column.

const NUMBER = "[+-]?(?:\\d+\\.?\\d*|\\.\\d+)(?:[eE][+-]?\\d+)?";
const COMPARED = new RegExp(`^(<=|>=|<|>|!=|=|)(${NUMBER})$`);
const RANGE = new RegExp(`^(${NUMBER})\\.\\.(${NUMBER})$`);

const filters = new Map(); // column name -> a test of a row
let wantedText = "";
let haystack = null;

// "<20 !=3" -> a test of numbers, all of whose parts must hold; null where it cannot be read.
function numberTest(expression) {
  // A sign of comparison may stand apart from its number.
  const parts = expression.replace(/([<>=!]=?)\s+/g, "$1").split(/[\s,;]+/).filter(Boolean);
  const tests = parts.map((part) => {
    const range = RANGE.exec(part);
    if (range) return (value) => value >= Number(range[1]) && value <= Number(range[2]);
    const compared = COMPARED.exec(part);
    if (!compared) return null;
    const limit = Number(compared[2]);
    const same = (value) => Math.abs(value - limit) <= 1e-9 * Math.abs(limit);
    return {
      "<": (value) => value < limit,
      ">": (value) => value > limit,
      "<=": (value) => value <= limit,
      ">=": (value) => value >= limit,
      "!=": (value) => !same(value),
      "=": same,
      "": same,
    }[compared[1]];
  });
  return tests.includes(null) ? null : (value) => !Number.isNaN(value) && tests.every((test) => test(value));
}

// A piece of text, =whole text, or !piece that must not be there.
function textTest(expression) {
  const wanted = expression.toLowerCase();
  if (wanted.startsWith("=")) return (text) => text === wanted.slice(1);
  if (wanted.startsWith("!")) return (text) => !text.includes(wanted.replace(/^!=?/, ""));
  return (text) => text.includes(wanted);
}

// Whether the expression could be read; an empty one lifts the column's filter.
function setFilter(column, expression) {
  const trimmed = expression.trim();
  filters.delete(column.name);
  let readable = true;
  if (trimmed && column.number) {
    const test = numberTest(trimmed);
    readable = test !== null;
    // A number as it is shown finds its rows too, though it was rounded for show.
    const shown = new RegExp(`^${NUMBER}$`).test(trimmed);
    if (test) filters.set(column.name, (row) => test(column.cells[row]) || (shown && written(column, row) === trimmed));
  } else if (trimmed) {
    const test = textTest(trimmed);
    filters.set(column.name, (row) => test(String(column.cells[row] ?? "").toLowerCase()));
  }
  applyFilters();
  return readable;
}

function setText(text) {
  wantedText = text.trim().toLowerCase();
  applyFilters();
}

function searched(row) {
  if (!haystack) {
    const read = columns.filter((column) => column.kind !== "metric");
    haystack = everyRow.map((k) => read.map((column) => written(column, k)).join("\n").toLowerCase());
  }
  return wantedText.split(/\s+/).every((word) => haystack[row].includes(word));
}

function applyFilters() {
  const tests = [...filters.values()];
  if (wantedText) tests.push(searched);
  state.rows = tests.length ? everyRow.filter((row) => tests.every((test) => test(row))) : everyRow;
  byId("clear").hidden = tests.length === 0;
  tell("rows");
}
