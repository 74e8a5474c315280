// The samples of the signals that are shown: rings of one length, side by side, so that a place is one instant in all.

/** Two minutes of a cycle of 1 ms. */
const ROOM = 1 << 17;

class Column {
  constructor(room) {
    this.min = new Float64Array(room).fill(NaN);
    // The same array, until an envelope makes it two.
    this.max = this.min;
  }

  split() {
    if (this.max === this.min) this.max = this.min.slice();
  }
}

export class Store {
  constructor(room = ROOM) {
    this.room = room;
    this.times = new Float64Array(room);
    this.cycles = new Float64Array(room);
    // The cycles of each sample; of several it is their envelope.
    this.widths = new Uint8Array(room);
    this.columns = new Map();
    // All samples ever: the next one has the place written % room.
    this.written = 0;
  }

  clear() {
    this.written = 0;
    this.columns.clear();
  }

  /** Keeps these signals, and forgets all others. */
  keep(ids) {
    for (const id of this.columns.keys()) if (!ids.has(id)) this.columns.delete(id);
    for (const id of ids) if (!this.columns.has(id)) this.columns.set(id, new Column(this.room));
  }

  /** Takes in a frame. */
  enter(buffer) {
    const view = new DataView(buffer);
    if (view.getUint8(0) !== 2) throw new Error("this page is of another version: reload it");
    const width = view.getUint8(1);
    const isEnvelope = width > 1;
    const signals = view.getUint16(2, true);
    const count = view.getUint32(4, true);
    let at = 8 + 8 * Math.ceil(signals / 2);
    const next = () => {
      const values = new Float64Array(buffer, at, count);
      at += 8 * count;
      return values;
    };
    this.put(this.times, next());
    this.put(this.cycles, next());
    this.put(this.widths, new Uint8Array(count).fill(width));
    const missing = new Set(this.columns.keys());
    for (let index = 0; index < signals; index++) {
      const id = view.getUint32(8 + 4 * index, true);
      const min = next();
      const max = isEnvelope ? next() : min;
      const column = this.columns.get(id);
      if (!column) continue;
      missing.delete(id);
      if (isEnvelope) column.split();
      this.put(column.min, min);
      if (column.max !== column.min) this.put(column.max, max);
    }
    const nothing = new Float64Array(count).fill(NaN);
    for (const id of missing) {
      const column = this.columns.get(id);
      this.put(column.min, nothing);
      if (column.max !== column.min) this.put(column.max, nothing);
    }
    this.written += count;
  }

  put(ring, values) {
    const from = this.written % this.room;
    const whole = Math.min(values.length, this.room - from);
    ring.set(values.subarray(0, whole), from);
    if (whole < values.length) ring.set(values.subarray(whole), 0);
  }

  /** The samples from one up to before another, as a store of their own. */
  copy(from, to) {
    const [first, last] = [Math.max(from, this.oldest), Math.min(to, this.written)];
    const copy = new Store(Math.max(1, last - first));
    copy.written = Math.max(0, last - first);
    const take = (ring, into) => {
      for (let index = first; index < last; index++) into[index - first] = ring[index % this.room];
    };
    take(this.times, copy.times);
    take(this.cycles, copy.cycles);
    take(this.widths, copy.widths);
    for (const [id, column] of this.columns) {
      const own = new Column(copy.room);
      take(column.min, own.min);
      if (column.max !== column.min) {
        own.split();
        take(column.max, own.max);
      }
      copy.columns.set(id, own);
    }
    return copy;
  }

  /** The cycles of the newest sample. */
  get width() {
    return this.written ? this.widths[(this.written - 1) % this.room] : 1;
  }

  /** Whether there are envelopes from one sample up to before another. */
  hasEnvelopes(from, to) {
    for (let index = from; index < to; index++) if (this.widths[index % this.room] > 1) return true;
    return false;
  }

  get oldest() {
    return Math.max(0, this.written - this.room);
  }

  time(index) {
    return this.times[index % this.room];
  }

  cycle(index) {
    return this.cycles[index % this.room];
  }

  min(id, index) {
    const column = this.columns.get(id);
    return column ? column.min[index % this.room] : NaN;
  }

  max(id, index) {
    const column = this.columns.get(id);
    return column ? column.max[index % this.room] : NaN;
  }

  get newestTime() {
    return this.written ? this.time(this.written - 1) : NaN;
  }

  /** The first sample at or after an instant. */
  at(time) {
    let [low, high] = [this.oldest, this.written];
    while (low < high) {
      const middle = Math.floor((low + high) / 2);
      if (this.time(middle) < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}
