// Columns over time that drop values older than a window. Their memory is allocated once, so that updates twenty times a
// second cause no garbage. NaN marks missing values.

const FINEST = 0.02; // s between two points that are kept: finer than the resolution of a screen for a minute
export const WINDOW = 60; // s

export class Rolling {
  constructor(names, span = WINDOW) {
    this.span = span;
    this.length = 0;
    const room = Math.ceil(1.25 * span * (1 + 2 / FINEST)); // points are at least half of it apart, and gaps a second
    this.time = new Float64Array(room);
    this.ago = new Float64Array(room);
    this.columns = Object.fromEntries(names.map((name) => [name, new Float64Array(room)]));
  }

  get newest() {
    return this.length ? this.time[this.length - 1] : -Infinity;
  }

  add(t0, dt, arrays) {
    let rows = 0;
    for (const name in this.columns) rows = Math.max(rows, arrays[name]?.length ?? 0);
    if (this.length && t0 < this.time[0] - 1) this.length = 0;
    let last = this.newest;
    for (let row = 0; row < rows; row += 1) {
      const time = t0 + row * dt;
      if (time - last < (row === rows - 1 ? 0.5 : 0.99) * FINEST) continue;
      if (time - last > 1 && this.length) this.push(last + 1e-4, arrays, -1); // mark a gap
      this.push(time, arrays, row);
      last = time;
    }
  }

  push(time, arrays, row) {
    if (this.length === this.time.length) this.forget();
    this.time[this.length] = time;
    for (const name in this.columns) this.columns[name][this.length] = arrays[name]?.[row] ?? NaN;
    this.length += 1;
  }

  // Values of one column with their own time, assigned to the nearest points; the first value is left out, so that
  // separate segments are not joined.
  merge(t0, dt, name, values) {
    const column = this.columns[name];
    if (!column || !Array.isArray(values)) return;
    let place = this.after(t0 + dt - FINEST);
    for (let row = 1; row < values.length; row += 1) {
      const time = t0 + row * dt;
      while (place < this.length && this.time[place] < time - 0.6 * FINEST) place += 1;
      if (place < this.length && this.time[place] <= time + 0.6 * FINEST) column[place] = values[row] ?? NaN;
    }
  }

  // The place of the first point that is not before `time`.
  after(time) {
    let low = 0, high = this.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  forget() {
    const first = this.after(this.newest - this.span);
    for (const column of [this.time, ...Object.values(this.columns)]) column.copyWithin(0, first, this.length);
    this.length -= first;
  }

  // The newest value of this name.
  last(name) {
    return this.length ? this.columns[name][this.length - 1] : NaN;
  }

  // Set the window to that before the newest point.
  mark() {
    this.first = this.after(this.newest - this.span);
    const zero = this.newest;
    for (let place = this.first; place < this.length; place += 1) this.ago[place] = this.time[place] - zero;
    this.window = this.ago.subarray(this.first, this.length);
  }

  // The window: seconds before the newest point, and the columns of these names.
  shown(names) {
    return [this.window, ...names.map((name) => this.columns[name].subarray(this.first, this.length))];
  }
}
