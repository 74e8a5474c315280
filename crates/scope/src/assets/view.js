// What is seen: which samples, and from when to when. Live it follows the samples or the trigger; held it is moved.

/** An acquisition is looked at while it is made if it takes so long, s. */
const PROGRESSIVE = 0.5;
/** Without a trigger "auto" shows what comes after so long, or after a whole window, s. */
const AUTO = 0.5;

export class View {
  constructor(store, trigger) {
    this.store = store;
    this.trigger = trigger;
    this.span = 2;
    this.reset();
  }

  reset() {
    this.held = false;
    // A finished acquisition, which nothing overwrites any more.
    this.shot = null;
    this.origin = NaN;
    this.from = this.to = NaN;
    this.triggered = false;
    this.trigger.arm(this.store.written);
  }

  get data() {
    return this.shot ?? this.store;
  }

  /** Follows what came; returns whether anything is to be drawn anew. */
  follow() {
    const { store, trigger, span } = this;
    if (this.held || !store.written) return false;
    const newest = store.newestTime;
    if (trigger.isOff) return this.roll(newest);
    const at = trigger.look(store, span);
    if (at === null) {
      const waited = newest - (trigger.armedAt ?? newest);
      return trigger.mode === "auto" && !trigger.single && waited > Math.max(span, AUTO) && this.roll(newest);
    }
    const from = at - trigger.pre * span;
    const to = from + span;
    const isComplete = newest >= to;
    if (!isComplete && span < PROGRESSIVE) return false;
    this.show(from, to, at, true);
    if (!isComplete) return true;
    this.shot = store.copy(store.at(from) - 1, store.at(to) + 1);
    if (trigger.single) this.hold();
    else trigger.arm(store.at(to));
    return true;
  }

  roll(newest) {
    this.show(newest - this.span, newest, newest, false);
    return true;
  }

  show(from, to, origin, triggered) {
    Object.assign(this, { from, to, origin, triggered, shot: null });
  }

  hold() {
    this.held = true;
    this.trigger.single = false;
  }

  run() {
    this.held = false;
    this.shot = null;
    this.trigger.single = false;
    this.trigger.arm(this.store.written);
  }

  single() {
    this.run();
    this.trigger.single = true;
  }

  /** Shows this stretch of what was taken. */
  zoom(from, to) {
    if (!(to - from > 1e-6) || !this.data.written) return;
    const { data } = this;
    const [first, last] = [data.time(data.oldest), data.newestTime];
    const length = Math.min(to - from, Math.max(last - first, this.span));
    const begin = Math.min(Math.max(from, first - length / 2), last - length / 2);
    this.hold();
    [this.from, this.to] = [begin, begin + length];
  }

  /** By a factor, around a share of the width. */
  zoomBy(factor, around = 0.5) {
    const length = this.to - this.from;
    const fixed = this.from + around * length;
    this.zoom(fixed - around * length * factor, fixed + (1 - around) * length * factor);
  }

  pan(share) {
    const by = share * (this.to - this.from);
    this.zoom(this.from + by, this.to + by);
  }

  /** The whole window again. */
  fit() {
    if (Number.isNaN(this.origin)) return;
    const before = this.triggered ? this.trigger.pre * this.span : this.span;
    [this.from, this.to] = [this.origin - before, this.origin - before + this.span];
  }

  /** The samples that are seen: from this one up to before that one. */
  get range() {
    const { data } = this;
    return [data.at(this.from), Math.min(data.written, data.at(this.to) + 1)];
  }
}
