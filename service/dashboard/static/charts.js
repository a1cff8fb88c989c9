// Curves over time by uPlot: a window of bounded length that moves on, drawn at most once a frame, and figures with bands.

const FINEST = 0.02; // s between two points that are kept: finer than a screen shows of a minute
export const WINDOW = 60; // s

const style = () => getComputedStyle(document.documentElement);
export const colour = (name) => style().getPropertyValue(`--${name}`).trim();

// Of width 1: what is drawn anew twenty times a second is drawn without a graphics card ten times faster than at 1.5.
const LOOKS = {
  measured: { stroke: "blue", width: 1 },
  setpoint: { stroke: "grey", width: 1, dash: [6, 3] },
  predicted: { stroke: "orange", width: 1, dash: [3, 2] },
  innovation: { stroke: "green", width: 1 },
};

const made = new Set();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => made.forEach((chart) => chart.rebuild()));
new ResizeObserver(() => made.forEach((chart) => chart.resize())).observe(document.documentElement);

const ticked = (_, ticks) => ticks.map((tick) => (tick === null ? "" : String(Number(tick.toPrecision(4)))));
const LETTER = 7; // px, of a label's
const longest = (values) => Math.max(1, ...(values ?? []).map((value) => String(value).length));
// As wide as its labels are; the next guess is made from those that are there.
const wide = (_, values) => Math.max(40, 24 + LETTER * longest(values));
const apart = (plot, axis) => Math.max(50, 20 + LETTER * longest(plot.axes[axis]._values));

// What is constant is drawn in the middle, and not as if it were large.
function spread(_, low, high) {
  if (low === null || high === null) return [-1, 1];
  const room = Math.max(0.08 * (high - low), 0.05 * Math.max(Math.abs(low), Math.abs(high)) * (high === low), 1e-9);
  return high - low < 1e-9 ? [low - Math.max(room, 0.5), high + Math.max(room, 0.5)] : [low - room, high + room];
}

// A uPlot in `place`, made when it is first seen, made anew when colours change.
export class Chart {
  constructor(place, options, height = 180) {
    this.place = place;
    this.options = options;
    this.height = height;
    this.data = [[], ...options.series.map(() => [])];
    made.add(this);
  }

  build() {
    const axis = { stroke: colour("text"), grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid") }, font: "12px system-ui" };
    const { series, xLabel, yLabel, ...rest } = this.options;
    this.plot = new uPlot({
      width: this.width(), height: this.height, cursor: { drag: { x: false, y: false } },
      legend: { live: false, markers: { dash: (plot, place) => (plot.series[place].dash ? "dashed" : "solid") } }, ...rest, scales: { x: { time: false }, y: { range: spread }, ...rest.scales },
      axes: [
        { ...axis, label: xLabel, labelSize: xLabel ? 16 : 0, labelFont: "12px system-ui", size: 30, space: apart, values: ticked },
        { ...axis, label: yLabel, labelSize: 16, labelFont: "12px system-ui", size: wide, values: ticked },
      ],
      series: [{}, ...series.map((each) => {
        const look = LOOKS[each.look] ?? each;
        return { label: each.label, class: each.label ? undefined : "unnamed", width: look.width ?? 1.5, dash: look.dash, stroke: colour(look.stroke), spanGaps: each.gaps ?? false,
          fill: each.fill ? colour(each.fill) : undefined, points: { show: each.points ?? false, size: 6 }, paths: each.paths };
      })],
    }, this.data, this.place);
  }

  width() {
    return Math.max(240, this.place.clientWidth);
  }

  resize() {
    if (this.plot && this.place.clientWidth && this.plot.width !== this.width()) this.plot.setSize({ width: this.width(), height: this.height });
  }

  rebuild() {
    if (!this.plot) return;
    this.plot.destroy();
    this.plot = null;
    this.draw();
  }

  set(data) {
    this.data = data;
    this.draw();
  }

  draw() {
    if (!this.place.clientWidth) return; // not on the screen
    if (!this.plot) this.build();
    else this.plot.setData(this.data);
  }

  destroy() {
    made.delete(this);
    this.plot?.destroy();
  }
}

// Columns over time that forget what is older than `span`; memory is bounded however long the page is open.
export class Rolling {
  constructor(names, span = WINDOW) {
    this.names = names;
    this.span = span;
    this.clear();
  }

  clear() {
    this.time = [];
    this.columns = Object.fromEntries(this.names.map((name) => [name, []]));
  }

  add(t0, dt, arrays, from = 0) {
    const rows = Math.max(0, ...this.names.map((name) => arrays[name]?.length ?? 0));
    if (this.time.length && t0 < this.time[0] - 1) this.clear();
    let last = this.time.length ? this.time[this.time.length - 1] : -Infinity;
    for (let row = from; row < rows; row += 1) {
      const time = t0 + row * dt;
      if (time <= last || (time - last < 0.99 * FINEST && row !== rows - 1)) continue;
      if (time - last < 0.5 * FINEST) continue;
      // A gap is drawn as one.
      if (time - last > 1 && this.time.length) {
        this.time.push(last + 1e-4);
        this.names.forEach((name) => this.columns[name].push(null));
      }
      this.time.push(time);
      this.names.forEach((name) => this.columns[name].push(arrays[name]?.[row] ?? null));
      last = time;
    }
    this.forget(last);
  }

  // Values of one column on a time of their own, put where the nearest points are; the first is left out, so that
  // stretches which begin anew are not joined.
  merge(t0, dt, name, values) {
    if (!this.columns[name] || !Array.isArray(values)) return;
    let place = 0;
    for (let row = 1; row < values.length; row += 1) {
      const time = t0 + row * dt;
      if (row === 1) place = this.after(time - FINEST);
      while (place < this.time.length && this.time[place] < time - 0.6 * FINEST) place += 1;
      if (place < this.time.length && this.time[place] <= time + 0.6 * FINEST) this.columns[name][place] = values[row];
    }
  }

  after(time) {
    let low = 0, high = this.time.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  forget(last) {
    const oldest = last - this.span;
    if (this.time.length && this.time[0] < oldest - 0.25 * this.span) {
      const first = this.time.findIndex((time) => time >= oldest);
      this.time.splice(0, first);
      this.names.forEach((name) => this.columns[name].splice(0, first));
    }
  }
}

export const turned = (column, factor) => column.map((value) => (value === null || value === undefined ? null : value * factor));
