// The table: sorted by a heading, filtered under it; only the rows in sight are elements, so 10,000 scroll freely.

const scroller = byId("scroll");
const body = scroller.querySelector("tbody");
const sorting = { column: null, down: false };
const visible = new Set(
  columns
    .filter((column) => {
      if (column.name === "run") return true;
      if (column.kind === "key") return column.varies;
      if (column.kind === "metric") return column.shown;
      return column.varies || (column.name === "status" && statuses.some((status) => status !== "complete"));
    })
    .map((column) => column.name),
);
const inSight = () => columns.filter((column) => visible.has(column.name));
let drawn = "";

function widthOf(column) {
  const step = Math.max(1, Math.floor(total / 200));
  let longest = 0;
  for (let row = 0; row < total; row += step) longest = Math.max(longest, written(column, row).length);
  const word = Math.max(...column.words.split(/(?<=[ ._])/).map((part) => part.length));
  const share = column.words.length / 2.6;
  return Math.min(column.name === "run" ? 24 : 34, Math.max(longest, word, share, 7)) + 2.5;
}

function buildHead() {
  const shown = inSight();
  scroller.querySelector("colgroup").replaceChildren(
    ...shown.map((column) => make("col", { style: `width:${widthOf(column)}ch` })),
  );
  const heads = shown.map((column) => {
    const turned = sorting.column === column ? (sorting.down ? " ▼" : " ▲") : "";
    const way = turned ? (sorting.down ? "descending" : "ascending") : "none";
    const button = make("button", { type: "button", onclick: () => sortBy(column) }, ...breakable(column.words), turned, make("small", {}, column.unit));
    return make("th", { scope: "col", "aria-sort": way, "data-column": column.name, class: column.number ? "number" : "" }, button);
  });
  const inputs = shown.map((column) => {
    const input = make("input", {
      type: "text", "data-filter": column.name, "aria-label": `Filter ${heading(column)}`, autocomplete: "off",
      spellcheck: "false", placeholder: column.number ? "< > =" : "text", value: column.filter ?? "",
    });
    input.addEventListener("input", () => {
      column.filter = input.value;
      const readable = setFilter(column, input.value);
      input.setAttribute("aria-invalid", String(!readable));
      input.title = readable ? "" : "Not understood: write <20, >=0.3, 5..15 or !=1";
    });
    return make("th", {}, input);
  });
  scroller.querySelector("thead").replaceChildren(make("tr", {}, ...heads), make("tr", {}, ...inputs));
}

function sortRows() {
  const { column, down } = sorting;
  if (!column) {
    state.order = state.rows;
    return;
  }
  const sign = down ? -1 : 1;
  const { cells } = column;
  const compare = column.number ? (a, b) => cells[a] - cells[b] : undefined;
  const collator = new Intl.Collator("en", { numeric: true });
  const empty = column.number ? (row) => Number.isNaN(cells[row]) : (row) => cells[row] === null || cells[row] === "";
  // What has no value comes last either way; equal rows keep their order.
  state.order = state.rows.slice().sort((a, b) => {
    const [x, y] = [empty(a), empty(b)];
    if (x || y) return x - y || a - b;
    return sign * (compare ? compare(a, b) : collator.compare(cells[a], cells[b])) || a - b;
  });
}

function sortBy(column) {
  sorting.down = sorting.column === column ? !sorting.down : false;
  sorting.column = column;
  sortRows();
  buildHead();
  scroller.querySelector(`[data-column="${CSS.escape(column.name)}"] button`).focus({ preventScroll: true });
  scroller.scrollTop = 0;
  drawRows(true);
}

function rowElement(row, place, shown) {
  const cells = shown.map((column) => {
    const text = written(column, row);
    if (column.name === "run") {
      return make("th", { scope: "row", title: text }, make("button", { type: "button", "data-run": row }, text));
    }
    const lost = column.name === "status" && text !== "complete";
    const look = column.number ? "number" : lost ? "lost" : null;
    const exact = column.number && !column.missing[row] ? String(column.cells[row]) : text;
    return make("td", { class: look, title: exact }, text);
  });
  const chosen = row === state.chosen;
  return make("tr", { "data-row": row, "aria-rowindex": place + 2, "aria-selected": String(chosen), class: chosen ? "chosen" : null }, ...cells);
}

function drawRows(force = false) {
  const height = 33; // a cell and its line, as the style has them
  const head = scroller.querySelector("thead").offsetHeight;
  const first = Math.max(0, Math.floor(scroller.scrollTop / height) - 12);
  const last = Math.min(state.order.length, Math.ceil((scroller.scrollTop + scroller.clientHeight - head) / height) + 12);
  if (!force && drawn === `${first} ${last}`) return;
  drawn = `${first} ${last}`;
  const shown = inSight();
  const held = document.activeElement?.dataset?.run; // a row in focus keeps it while the table is drawn anew
  const space = (rows) => make("tr", { class: "space", "aria-hidden": "true" }, make("td", { colspan: shown.length, style: `height:${rows * height}px` }));
  const rows = state.order.slice(first, last).map((row, k) => rowElement(row, first + k, shown));
  if (!state.order.length) rows.push(make("tr", { class: "space" }, make("td", { colspan: shown.length }, "No run passes the filters.")));
  body.replaceChildren(...(first ? [space(first)] : []), ...rows, ...(last < state.order.length ? [space(state.order.length - last)] : []));
  scroller.querySelector("table").setAttribute("aria-rowcount", state.order.length + 1);
  if (held !== undefined) body.querySelector(`[data-run="${held}"]`)?.focus({ preventScroll: true });
}

function buildChoice() {
  const boxes = columns.filter((column) => column.name !== "run").map((column) => {
    const box = make("input", { type: "checkbox", checked: visible.has(column.name), "data-show": column.name });
    box.addEventListener("change", () => {
      visible[box.checked ? "add" : "delete"](column.name);
      buildHead();
      drawRows(true);
    });
    return make("label", {}, box, ` ${heading(column)}`);
  });
  byId("columns").querySelector("div").append(...boxes);
}

function startTable() {
  let waiting = false;
  const later = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      drawRows();
    });
  };
  scroller.addEventListener("scroll", later, { passive: true });
  addEventListener("resize", later);
  body.addEventListener("click", (event) => {
    const row = event.target.closest("tr[data-row]");
    if (row) choose(Number(row.dataset.row));
  });
  byId("find").addEventListener("input", (event) => setText(event.target.value));
  byId("clear").addEventListener("click", () => {
    filters.clear();
    columns.forEach((column) => delete column.filter);
    byId("find").value = "";
    buildHead();
    setText("");
  });
  on("rows", () => {
    sortRows();
    scroller.scrollTop = 0;
    drawRows(true);
  });
  on("chosen", () => drawRows(true));
  buildChoice();
  buildHead();
  drawRows(true);
}
