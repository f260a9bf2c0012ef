// One run: its settings, all its metrics, its figures and its film.

function facts(caption, list, row) {
  const rows = list.map((column) => {
    const exact = column.number ? String(column.cells[row]) : null;
    return make("tr", {}, rowHead(column), make("td", { title: exact, class: column.number ? "number" : null }, written(column, row)));
  });
  return make("table", { class: "facts" }, make("caption", {}, caption), make("tbody", {}, ...rows));
}

function drawRun() {
  const row = state.chosen;
  const given = (column) => (column.number ? !column.missing[row] : column.cells[row] !== null);
  const words = [make("h3", { style: "margin:0;overflow-wrap:anywhere" }, names[row])];
  const note = byName.get("note").cells[row];
  if (statuses[row] !== "complete" || note) {
    words.push(make("p", { class: "lost" }, [statuses[row] === "complete" ? "" : statuses[row], note].filter(Boolean).join(": ")));
  }
  const settings = keys.filter(given);
  if (settings.length) words.push(facts("Settings", settings, row));
  const numbers = metrics.filter(given);
  if (numbers.length) words.push(facts("Metrics", numbers, row));
  const pictures = picturesOf(row).map((picture) => pictureElement(picture, row));
  byId("detail").replaceChildren(make("div", {}, ...words), make("div", { class: "gallery" }, ...(pictures.length ? pictures : [absent(row)])));
  byId("detail").dataset.row = row;
  drawPick();
}

// The runs with figures, and the one in sight: a list of 10,000 would help nobody; the table chooses those.
function drawPick() {
  const listed = new Set(Object.keys(data.pictures).map(Number));
  if (total <= 200) everyRow.forEach((row) => listed.add(row));
  listed.add(state.chosen);
  const options = [...listed].sort((a, b) => a - b).map((row) => [String(row), names[row]]);
  fill(byId("pick"), options, String(state.chosen));
}

function step(by) {
  const order = state.order.length ? state.order : everyRow;
  const at = order.indexOf(state.chosen);
  choose(order[at < 0 ? 0 : (at + by + order.length) % order.length]);
}

// Chooses a run and brings it in sight.
function show(row) {
  choose(row);
  byId("run").scrollIntoView();
}

function startRun() {
  byId("pick").addEventListener("change", (event) => choose(Number(event.target.value)));
  byId("previous").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  on("chosen", drawRun);
  drawRun();
}
