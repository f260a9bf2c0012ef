// The best and the worst of the rows in the table, side by side.

function ratio(best, worst) {
  if (!(Number.isFinite(best) && Number.isFinite(worst)) || best === 0 || worst / best <= 0) return "";
  return `× ${short(Number((worst / best).toPrecision(3)))}`;
}

function factRow(column, best, worst) {
  const texts = [written(column, best), written(column, worst)];
  const look = column.name === state.metric ? "rank" : texts[0] === texts[1] ? "alike" : null;
  const gap = column.kind === "metric" ? ratio(column.cells[best], column.cells[worst]) : "";
  return make("tr", { class: look }, rowHead(column), ...[...texts, gap].map((text) => make("td", { class: column.number ? "number" : null }, text)));
}

// Why a run is the first, or the last, of the order.
function reason(word, row, order, first) {
  const column = byName.get(state.metric);
  const stands = standing(row);
  const like = order.filter((other) => standing(other).level === stands.level).length;
  const way = first !== state.descending ? "smallest" : "largest";
  const among = like === order.length ? "" : stands.why ? ` of the ${like} that stand so` : ` of the ${like} that arrive and keep every limit`;
  return `${word}: ${names[row]}: ${stands.why ? `${stands.why}; ` : ""}its ${column.words}, ${written(column, row)} ${column.unit}`.trim() + `, is the ${way}${among}.`;
}

function drawPair() {
  const order = ranked(state.rows).filter((row) => Number.isFinite(byName.get(state.metric).cells[row]));
  const [table, figures] = [byId("pair"), byId("pair-figures")];
  if (order.length < 2) {
    table.replaceChildren();
    byId("why").textContent = "";
    byId("figure-choice").hidden = true;
    figures.replaceChildren(make("p", { class: "hint" }, "Two complete runs are needed to compare."));
    return;
  }
  const [best, worst] = [order[0], order[order.length - 1]];
  byId("why").replaceChildren(reason("Best", best, order, true), make("br"), reason("Worst", worst, order, false));
  const head = (row, word, look) => make("th", { scope: "col" }, make("span", { class: look }, word), make("br"),
    make("button", { type: "button", title: "Show this run", "data-pair": look, onclick: () => show(row) }, names[row]));
  const differ = keys.filter((column) => column.varies && written(column, best) !== written(column, worst));
  const known = (column) => !(column.missing[best] && column.missing[worst]);
  const told = [byName.get(state.metric), ...metrics.filter((column) => column.shown && column.name !== state.metric && known(column))];
  table.replaceChildren(
    make("thead", {}, make("tr", {}, make("th", { scope: "col" }, `by ${heading(byName.get(state.metric))}`), head(best, "best", "best"), head(worst, "worst", "worst"), make("th", { scope: "col" }, "worst / best"))),
    make("tbody", {}, ...[...differ, ...told].map((column) => factRow(column, best, worst))),
  );
  drawPairFigures(best, worst);
}

function drawPairFigures(best, worst) {
  const known = new Map([...picturesOf(best), ...picturesOf(worst)].map((picture) => [picture.name, picture.caption]));
  const select = byId("figure");
  const wish = known.has(select.value) ? select.value : [...known.keys()][0];
  byId("figure-choice").hidden = known.size === 0;
  fill(select, [...known], wish);
  const side = (row, word) => {
    const picture = picturesOf(row).find((entry) => entry.name === wish);
    return picture ? pictureElement(picture, row, `${word}: ${names[row]}`) : absent(row);
  };
  const neither = !known.size && absent(best).textContent === absent(worst).textContent;
  byId("pair-figures").replaceChildren(...(neither ? [absent(best)] : [side(best, "best"), side(worst, "worst")]));
}

function startCompare() {
  byId("figure").addEventListener("change", drawPair);
  on("rows", drawPair);
  on("metric", drawPair);
  drawPair();
}
