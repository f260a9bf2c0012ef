// Axes and colours of the plots.

// Okabe and Ito's colours, told apart under every common colour blindness; a shape goes with each.
const PALETTE = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"];
const SHAPES = ["circle", "square", "triangle", "diamond", "cross", "plus"];
// Viridis, without its ends that vanish on white and on black.
const RAMP = [[68, 1, 84], [65, 68, 135], [42, 120, 142], [34, 168, 132], [122, 209, 81], [200, 226, 32]];

const isDark = () => document.documentElement.dataset.theme === "dark";

function ramp(share) {
  const [from, to] = isDark() ? [1.4, 5] : [0, 4.5];
  const at = from + (to - from) * Math.min(1, Math.max(0, share));
  const k = Math.min(RAMP.length - 2, Math.floor(at));
  return `rgb(${RAMP[k].map((low, c) => Math.round(low + (RAMP[k + 1][c] - low) * (at - k))).join(",")})`;
}

// 1, 2 or 5 times a power of ten, so that about `count` steps fill the span.
function niceStep(span, count) {
  const rough = span / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * ([1, 2, 5].find((factor) => factor * power >= rough) ?? 10);
}

// A scale of numbers: at(value) in 0..1, ticks, and whether it is logarithmic. Values must be finite.
function numberScale(values, wish, fewest = 10) {
  let low = Infinity;
  let high = -Infinity;
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  const log = low > 0 && (wish === "log" || (wish === "auto" && high / low >= fewest));
  const to = log ? Math.log10 : (value) => value;
  let [start, end] = [to(low), to(high)];
  const pad = end > start ? 0.06 * (end - start) : log ? 0.3 : Math.abs(start) * 0.1 || 1;
  [start, end] = [start - pad, end + pad];
  const ticks = log ? logTicks(start, end) : linearTicks(start, end);
  return { log, ticks, at: (value) => (to(value) - start) / (end - start) };
}

function linearTicks(start, end) {
  const step = niceStep(end - start, 5);
  const first = Math.ceil(start / step - 1e-9);
  const last = Math.floor(end / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(10)));
}

function logTicks(start, end) {
  const factors = end - start > 4 ? [1] : end - start > 1.6 ? [1, 3] : [1, 2, 5];
  const ticks = [];
  for (let power = Math.floor(start); power <= end; power += end - start > 8 ? 2 : 1) {
    for (const factor of factors) {
      const value = Number((factor * 10 ** power).toPrecision(6));
      if (Math.log10(value) >= start && Math.log10(value) <= end) ticks.push(value);
    }
  }
  return ticks.length > 1 ? ticks : linearTicks(10 ** start, 10 ** end).filter((value) => value > 0);
}

// The horizontal scale of a swept key: numbers where they are, with their own values as ticks while they are few.
function keyScale(column, rows) {
  const found = distinct(column, rows);
  if (column.number && found.every(Number.isFinite)) {
    const scale = numberScale(found, "auto");
    if (found.length <= 8) scale.ticks = found;
    return { ...scale, found, name: String };
  }
  const place = new Map(found.map((value, k) => [value, (k + 0.5) / found.length]));
  return { log: false, found, ticks: found, at: (value) => place.get(value), name: String };
}

// How a key colours points: by kind for up to six values, along a ramp for more, one colour for none.
function colouring(column, rows) {
  if (!column) return { kinds: [], of: () => 0, colour: () => PALETTE[0] };
  const found = distinct(column, rows);
  if (found.length <= PALETTE.length) {
    const place = new Map(found.map((value, k) => [value, k]));
    return { column, kinds: found, of: (row) => place.get(column.cells[row]) ?? 0, colour: (row) => PALETTE[place.get(column.cells[row]) ?? 0] };
  }
  const scale = keyScale(column, rows);
  return { column, kinds: [], found, of: () => 0, colour: (row) => ramp(scale.at(column.cells[row])) };
}
