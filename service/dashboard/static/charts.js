// Charts by uPlot, drawn at most once per frame. A chart outside the screen has no canvas and costs nothing; in print all have one.

import { WINDOW } from "./rolling.js";

const style = () => getComputedStyle(document.documentElement);
export const colour = (name) => style().getPropertyValue(`--${name}`).trim();

// Width 1: without a graphics card, redrawing is ten times faster than at 1.5, and it happens twenty times a second.
const LOOKS = {
  measured: { stroke: "blue", width: 1 },
  setpoint: { stroke: "grey", width: 1, dash: [6, 3] },
  predicted: { stroke: "orange", width: 1, dash: [3, 2] },
  innovation: { stroke: "green", width: 1 },
};

const made = new Set();
let paper = false; // the page is being printed
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => made.forEach((chart) => chart.rebuild()));
const watch = new IntersectionObserver((entries) => entries.forEach((entry) => [...made].find((chart) => chart.place === entry.target)?.show(entry.isIntersecting)));
new ResizeObserver(() => made.forEach((chart) => chart.resize())).observe(document.documentElement);

const ticked = (_, ticks) => ticks.map((tick) => (tick === null ? "" : String(Number(tick.toPrecision(4)))));
const LETTER = 7; // px, width of a letter of a label
const longest = (values) => Math.max(1, ...(values ?? []).map((value) => String(value).length));
// As wide as its labels; the first estimate is made from the present ones.
const wide = (_, values) => Math.max(40, 24 + LETTER * longest(values));
const apart = (plot, axis) => Math.max(50, 20 + LETTER * longest(plot.axes[axis]._values));

// A constant is drawn in the middle of the axis, with a finite range around it.
function spread(_, low, high) {
  if (low === null || high === null) return [-1, 1];
  const room = Math.max(0.08 * (high - low), 0.05 * Math.max(Math.abs(low), Math.abs(high)) * (high === low), 1e-9);
  return high - low < 1e-9 ? [low - Math.max(room, 0.5), high + Math.max(room, 0.5)] : [low - room, high + room];
}

// Draws columns of numbers, times `factor`, in which NaN is a gap. uPlot's own drawing boxes each number and makes a path
// object of each curve: 40 MB/s of garbage. uPlot caches the context's state, so it is restored, by hand: a saved state is
// 1 kB of garbage.
function curves(plot, factor) {
  const { ctx } = plot, { strokeStyle, lineWidth } = ctx, dash = ctx.getLineDash();
  for (let place = 1; place < plot.data.length; place += 1) if (plot.series[place].show) line(plot, place, factor);
  ctx.strokeStyle = strokeStyle;
  ctx.lineWidth = lineWidth;
  ctx.setLineDash(dash);
}

// In each column of pixels the first, lowest, highest and last points are joined, as in uPlot.
function line(plot, place, factor) {
  const x = plot.data[0], y = plot.data[place], { left, top, width, height } = plot.bbox, { ctx } = plot;
  const { min: from, max: to } = plot.scales.x, { min: low, max: high } = plot.scales.y;
  const look = plot.series[place], thick = look.width * devicePixelRatio, sharp = (thick % 2) / 2;
  const across = width / (to - from), up = factor * height / (high - low), base = top + height * high / (high - low);
  let column = NaN, least = 0, most = 0, last = 0, pen = false;
  ctx.beginPath();
  for (let row = 0; row < x.length; row += 1) {
    if (Number.isNaN(y[row])) {
      pen = false;
      continue;
    }
    const right = Math.round(left + (x[row] - from) * across) + sharp, down = Math.round(Math.min(Math.max(base - y[row] * up, top), top + height)) + sharp;
    if (pen && right === column) {
      least = Math.min(least, down);
      most = Math.max(most, down);
    } else {
      if (most > least) {
        ctx.lineTo(column, least);
        ctx.lineTo(column, most);
        ctx.lineTo(column, last);
      }
      if (pen) ctx.lineTo(right, down);
      else ctx.moveTo(right, down);
      column = right;
      least = most = down;
      pen = true;
    }
    last = down;
  }
  ctx.strokeStyle = look.stroke(plot, place);
  ctx.lineWidth = thick;
  ctx.setLineDash((look.dash ?? []).map((each) => each * devicePixelRatio));
  ctx.stroke();
}

// The range of such columns, or of the `latest` share of them. It is kept while they are within it and fill half of it: axes
// that move with every sample are hard to read, and need a new layout each time.
function extent(factor, latest) {
  let kept = [NaN, NaN];
  return (plot) => {
    let low = Infinity, high = -Infinity;
    for (let place = 1; place < plot.data.length; place += 1) {
      if (!plot.series[place].show) continue;
      const column = plot.data[place];
      for (let row = Math.floor((1 - latest) * column.length); row < column.length; row += 1) {
        if (column[row] < low) low = column[row];
        if (column[row] > high) high = column[row];
      }
    }
    const wanted = low > high ? spread(plot, null, null) : spread(plot, factor * low, factor * high);
    const within = kept[0] <= factor * low && factor * high <= kept[1];
    if (!within || kept[1] - kept[0] > 2 * (wanted[1] - wanted[0])) kept = wanted;
    return kept;
  };
}

// Further options of a chart of such columns.
const STEP = 10; // s, step of the displayed time range
export const columns = (factor, latest = 1) => ({
  scales: { x: { time: false, range: (_, low) => [Math.max(-WINDOW, Math.min(-STEP, STEP * Math.floor(low / STEP))), 0] }, y: { range: extent(factor, latest) } },
  hooks: { draw: [(plot) => curves(plot, factor)] },
  paths: () => null,
});

// A uPlot in `place`, created when it is visible, and again when the colours change.
export class Chart {
  constructor(place, options, height = 180) {
    this.place = place;
    this.options = options;
    this.height = height;
    this.data = [[], ...options.series.map(() => [])];
    this.seen = false;
    made.add(this);
    watch.observe(place);
  }

  // Whether it is visible on the screen or in print.
  get visible() {
    return this.seen || (paper && this.place.clientWidth > 0);
  }

  show(seen) {
    this.seen = seen;
    if (this.visible) this.draw();
    else this.drop();
  }

  build() {
    const axis = { stroke: colour("text"), grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid") }, font: "12px system-ui" };
    const { series, xLabel, yLabel, paths, ...rest } = this.options;
    this.plot = new uPlot({
      width: this.width(), height: this.height, cursor: { show: false },
      legend: { live: false, markers: { dash: (plot, place) => (plot.series[place].dash ? "dashed" : "solid") } }, ...rest, scales: { x: { time: false }, y: { range: spread }, ...rest.scales },
      axes: [
        { ...axis, label: xLabel, labelSize: xLabel ? 16 : 0, labelFont: "12px system-ui", size: 30, space: apart, values: ticked },
        { ...axis, label: yLabel, labelSize: 16, labelFont: "12px system-ui", size: wide, space: 20, values: ticked },
      ],
      series: [{}, ...series.map((each) => {
        const look = LOOKS[each.look] ?? each;
        return { label: each.label, class: each.label ? undefined : "unnamed", width: look.width ?? 1.5, dash: look.dash, stroke: colour(look.stroke), spanGaps: each.gaps ?? false,
          fill: each.fill ? colour(each.fill) : undefined, points: { show: each.points ?? false, size: 6 }, paths };
      })],
    }, this.data, this.place);
    this.place.style.minHeight = "";
  }

  width() {
    return Math.max(240, this.place.clientWidth);
  }

  resize() {
    if (this.plot && this.place.clientWidth && this.plot.width !== this.width()) this.plot.setSize({ width: this.width(), height: this.height });
  }

  rebuild() {
    if (!this.plot) return;
    this.drop();
    this.draw();
  }

  // Its place keeps its height; a canvas of size zero has no memory, even before it is collected.
  drop() {
    if (!this.plot) return;
    const { canvas } = this.plot.ctx;
    if (this.place.clientHeight) this.place.style.minHeight = `${this.place.clientHeight}px`;
    this.plot.destroy();
    this.plot = null;
    canvas.width = canvas.height = 0;
  }

  set(data) {
    this.data = data;
    this.draw();
  }

  draw() {
    if (!this.visible) return;
    if (!this.plot) this.build();
    else this.plot.setData(this.data);
  }

  destroy() {
    made.delete(this);
    watch.unobserve(this.place);
    this.drop();
  }
}

// In print, the page has another width and other colours.
export function print(begins) {
  paper = begins;
  made.forEach((chart) => {
    chart.drop();
    chart.show(chart.seen);
  });
}

export const turned = (column, factor) => column.map((value) => (value === null || value === undefined ? null : value * factor));
