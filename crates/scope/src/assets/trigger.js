// When an acquisition begins: a level, an edge, an event or a fault; and how much of the window is before it.

/** Looks for the trigger in samples as they come. `source` is the number of a signal, "event" or "fault". */
export class Trigger {
  constructor() {
    this.mode = "off";
    this.source = null;
    this.edge = "rising";
    this.level = 0;
    this.pre = 0.25;
    this.single = false;
    this.arm(0);
  }

  /** Looks from sample `from` on; what was found is forgotten. */
  arm(from) {
    this.at = null;
    this.from = from;
    this.pending = null;
    this.armedAt = null;
  }

  get isOff() {
    return this.mode === "off" && !this.single;
  }

  /** An event of the machine. */
  event(event) {
    const wanted = this.source === "event" || (this.source === "fault" && event.fault);
    if (wanted && this.at === null && this.pending === null) this.pending = event.t;
  }

  /** The instant of the trigger, or null; `span` is the window in seconds. */
  look(store, span) {
    if (this.at !== null || this.isOff) return this.at;
    if (this.armedAt === null && store.written) this.armedAt = store.time(Math.max(store.oldest, this.from - 1));
    if (this.source === "event" || this.source === "fault") {
      if (this.pending !== null && store.newestTime >= this.pending) this.at = this.pending;
      return this.at;
    }
    const id = this.source;
    if (id === null || !store.columns.has(id)) return null;
    // As much as is to be shown before it has to be there.
    const earliest = store.at(store.time(store.oldest) + this.pre * span);
    for (let index = Math.max(this.from, earliest, store.oldest + 1); index < store.written; index++) {
      if (this.meets(store, id, index)) {
        this.at = store.time(index);
        break;
      }
      this.from = index + 1;
    }
    return this.at;
  }

  meets(store, id, index) {
    const [low, high] = [store.min(id, index), store.max(id, index)];
    const before = index - 1;
    switch (this.edge) {
      case "above":
        return high > this.level;
      case "below":
        return low < this.level;
      case "rising":
        return store.min(id, before) < this.level && high >= this.level;
      default:
        return store.max(id, before) > this.level && low <= this.level;
    }
  }
}
