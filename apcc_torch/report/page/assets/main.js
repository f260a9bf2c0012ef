// The head of the page, what all parts share, and the start.

const THEMES = ["system", "light", "dark"];
const systemDark = matchMedia("(prefers-color-scheme: dark)");
let theme = "system";

function setTheme() {
  const dark = theme === "dark" || (theme === "system" && systemDark.matches);
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  byId("theme").textContent = `Theme: ${theme}`;
  tell("theme");
}

function describe(column) {
  const found = distinct(column, everyRow);
  const unit = column.unit ? ` ${column.unit}` : "";
  const text = (value) => (column.number ? String(Number(value.toPrecision(6))) : value);
  if (found.length <= 6) return found.map(text).join(", ") + unit;
  const ends = column.number ? `${short(found[0])} … ${short(found[found.length - 1])}${unit}, ` : "";
  return `${ends}${found.length.toLocaleString("en")} values`;
}

function drawHead() {
  const kinds = ["complete", "pruned", "failed", "unfinished", "broken"];
  const counts = kinds.map((kind) => [kind, statuses.filter((status) => status === kind).length]).filter(([, count]) => count);
  byId("counts").textContent = `${total.toLocaleString("en")} runs: ${counts.map(([kind, count]) => `${count.toLocaleString("en")} ${kind}`).join(", ")}`;
  const chip = (column) => make("div", { class: column.varies ? null : "fixed", title: column.varies ? "swept" : "the same in all runs" }, make("dt", {}, ...breakable(column.words)), make("dd", {}, describe(column)));
  const varying = keys.filter((column) => column.varies);
  byId("swept").append(...varying.map(chip), ...keys.filter((column) => !column.varies).map(chip));
  byId("versions").textContent = data.footer;
  const title = document.querySelector("h1");
  title.replaceChildren(...breakable(title.textContent));
}

function drawShown() {
  const all = state.rows.length === total;
  byId("shown").textContent = all ? `${total.toLocaleString("en")} runs` : `${state.rows.length.toLocaleString("en")} of ${total.toLocaleString("en")} runs pass the filters`;
}

function drawChosen() {
  byId("chosen").textContent = `Chosen: ${names[state.chosen]}`;
}

// Limits that the ranking puts first: runs that break one stand behind those that keep all.
function startLimits() {
  fill(byId("limited"), metrics.map((column) => [column.name, heading(column)]), metrics.find((column) => column.name.startsWith("end_effector"))?.name ?? state.metric);
  const draw = () => byId("limits").replaceChildren(...state.limits.map((limit) => make("button", { type: "button", class: "quiet", title: "Lift this limit", onclick: () => {
    state.limits.splice(state.limits.indexOf(limit), 1);
    draw();
    tell("metric");
  } }, `${heading(limit.column)} ${signOf(limit)} ${short(limit.value)} ✕`)));
  byId("limit").addEventListener("submit", (event) => {
    event.preventDefault();
    state.limits.push({ column: byName.get(byId("limited").value), most: byId("limit-way").value === "most", value: Number(byId("limit-value").value) });
    draw();
    tell("metric");
  });
}

function start() {
  byId("theme").addEventListener("click", () => {
    theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
    setTheme();
  });
  systemDark.addEventListener("change", setTheme);
  setTheme();
  fill(byId("metric"), metrics.map((column) => [column.name, heading(column)]), state.metric);
  byId("order").value = state.descending ? "down" : "up";
  byId("metric").addEventListener("change", (event) => {
    state.metric = event.target.value;
    state.descending = data.higher.includes(state.metric);
    byId("order").value = state.descending ? "down" : "up";
    tell("metric");
  });
  byId("order").addEventListener("change", (event) => {
    state.descending = event.target.value === "down";
    tell("metric");
  });
  startLimits();
  on("rows", drawShown);
  on("chosen", drawChosen);
  state.chosen = ranked(everyRow)[0] ?? 0;
  drawHead();
  drawShown();
  drawChosen();
  startPictures();
  startTable();
  startPlots();
  startCompare();
  startRun();
}

start();
