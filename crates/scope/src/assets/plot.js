// One plot: its signals, its canvas, and how it is zoomed, panned and measured.

/** Signals that a plot can tell apart by colour. */
export const MOST_SIGNALS = 8;

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** A number with as many digits as can be read at once. */
export function digits(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1e6) return value.toExponential(3);
  return value.toFixed(size >= 1000 ? 1 : size >= 100 ? 2 : size >= 1 ? 3 : 4);
}

/** A time as one reads it. */
export function seconds(value) {
  const size = Math.abs(value);
  if (!Number.isFinite(value)) return "–";
  if (size >= 1 || size === 0) return `${value.toFixed(4)} s`;
  return size >= 1e-3 ? `${(value * 1e3).toFixed(3)} ms` : `${(value * 1e6).toFixed(1)} us`;
}

/**
 * What is drawn of a stretch: each sample, or where there are more than the width has room for, the least and the
 * greatest of several.
 */
function drawn(view, ids, width) {
  const { data, origin } = view;
  let [first, last] = view.range;
  first = Math.max(first - 1, data.oldest);
  last = Math.min(last + 1, data.written);
  const each = Math.max(1, Math.ceil((last - first) / Math.max(width, 50)));
  const isWhole = each === 1 && !data.hasEnvelopes(first, last);
  const times = [];
  const values = ids.map(() => []);
  const put = (to, value) => to.push(Number.isNaN(value) ? null : value);
  if (isWhole) {
    for (let index = first; index < last; index++) {
      times.push(data.time(index) - origin);
      ids.forEach((id, place) => put(values[place], data.min(id, index)));
    }
    return [times, ...values];
  }
  // At the same places whatever the stretch begins with, so that nothing flickers.
  for (let begin = first - (first % each); begin < last; begin += each) {
    const [from, to] = [Math.max(begin, first), Math.min(begin + each, last)];
    times.push(data.time(from) - origin, data.time(to - 1) - origin);
    ids.forEach((id, place) => {
      let [low, high] = [NaN, NaN];
      for (let index = from; index < to; index++) {
        const [min, max] = [data.min(id, index), data.max(id, index)];
        if (!(min >= low)) low = min;
        if (!(max <= high)) high = max;
      }
      put(values[place], low);
      put(values[place], high);
    });
  }
  return [times, ...values];
}

/** The range of an axis: it grows at once, and shrinks when it is more than twice too large. */
function steady() {
  let known = null;
  return (_, min, max) => {
    if (min === null || max === null) return known ?? [0, 1];
    const least = Math.max(Math.abs(min), Math.abs(max)) * 1e-3 || 1;
    const size = Math.max(max - min, least);
    const [low, high] = [(min + max - size) / 2 - 0.06 * size, (min + max + size) / 2 + 0.06 * size];
    const fits = known && known[0] <= min && known[1] >= max && known[1] - known[0] < 2.2 * (high - low);
    if (!fits) known = [low, high];
    return known;
  };
}

export class Plot {
  /** `scope` has the view and the machine, and learns what the user does. */
  constructor(scope, signals) {
    this.scope = scope;
    this.signals = signals;
    this.element = document.createElement("section");
    this.element.className = "plot";
    this.head = this.element.appendChild(document.createElement("div"));
    this.head.className = "head";
    this.canvas = this.element.appendChild(document.createElement("div"));
    this.canvas.className = "canvas";
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.canvas);
    this.build();
  }

  remove() {
    this.observer.disconnect();
    this.uplot?.destroy();
    this.element.remove();
  }

  get height() {
    return innerWidth <= 480 ? 150 : 172;
  }

  resize() {
    const width = this.canvas.clientWidth - 4;
    if (this.uplot && width > 0 && (width !== this.uplot.width || this.height !== this.uplot.height)) {
      this.uplot.setSize({ width, height: this.height });
      this.draw();
    }
  }

  /** Anew, after its signals or the colours have changed. */
  build() {
    this.uplot?.destroy();
    this.buildHead();
    const machine = this.scope.machine;
    const of = this.signals.map((id) => machine.signals[id]);
    const units = [...new Set(of.map(({ unit }) => unit))];
    const [ink, grid, font] = [css("--dim"), css("--grid"), "11px system-ui, sans-serif"];
    const axis = { stroke: ink, font, labelFont: font, ticks: { show: false }, grid: { stroke: grid, width: 1 } };
    const scales = { x: { time: false, range: () => this.scope.shownRange() } };
    for (const unit of units) scales[unit || "1"] = { range: steady() };
    const y = units.slice(0, 2).map((unit, side) => ({
      ...axis,
      scale: unit || "1",
      side: side ? 1 : 3,
      size: 56,
      gap: 4,
      label: unit || " ",
      labelSize: 14,
      labelGap: 0,
      grid: { ...axis.grid, show: side === 0 },
      values: (_, ticks) =>
        ticks.map((tick) => (Math.abs(tick) >= 1e5 ? tick.toExponential(1) : String(+tick.toPrecision(6)))),
    }));
    if (!y.length) {
      scales["1"] = { range: [0, 1] };
      y.push({ ...axis, scale: "1", size: 56, label: " ", labelSize: 14, values: () => [] });
    }
    const series = of.map(({ unit }, place) => ({
      scale: unit || "1",
      stroke: css(`--c${place}`),
      width: 1.25,
      points: { show: false },
      spanGaps: false,
    }));
    this.uplot = new window.uPlot(
      {
        width: Math.max(this.canvas.clientWidth - 4, 100),
        height: this.height,
        scales,
        series: [{}, ...series],
        axes: [{ ...axis, size: 24, gap: 2, space: 70, values: (_, ticks) => this.ticks(ticks) }, ...y],
        legend: { show: false },
        padding: [6, units.length > 1 ? 0 : 20, 0, 0],
        cursor: {
          points: { show: false },
          y: false,
          sync: { key: "scope", setSeries: false },
          drag: { x: true, y: false, setScale: false, dist: 5 },
        },
        hooks: {
          setSelect: [(u) => this.select(u)],
          setCursor: [() => this.readout()],
          draw: [(u) => this.marks(u)],
        },
      },
      [[], ...series.map(() => [])],
      this.canvas,
    );
    this.listen(this.uplot.over);
    this.draw();
  }

  ticks(values) {
    const span = this.scope.view.to - this.scope.view.from;
    const [factor, unit] = span >= 1 ? [1, "s"] : span >= 1e-3 ? [1e3, "ms"] : [1e6, "us"];
    return values.map((value) => `${+(value * factor).toPrecision(7)} ${unit}`);
  }

  buildHead() {
    const { machine } = this.scope;
    const isOne = new Set(this.signals.map((id) => machine.signals[id].unit)).size === 1;
    const chips = this.signals.map((id, place) => {
      const chip = document.createElement("span");
      chip.className = "chip";
      const name = this.scope.nameOf(id);
      const mark = document.createElement("i");
      mark.className = `k${place}`;
      const value = document.createElement("b");
      // One unit stands at the axis.
      const unit = document.createElement("small");
      unit.textContent = isOne ? "" : machine.signals[id].unit;
      const remove = button("×", `Remove ${name}`, () => this.change(this.signals.filter((other) => other !== id)));
      chip.append(mark, name, value, unit, remove);
      return chip;
    });
    const add = document.createElement("select");
    add.ariaLabel = "Add a signal to this plot";
    add.append(new Option("+ signal", ""));
    const groups = new Map();
    machine.signals.forEach(({ axis, name }, id) => {
      if (!name || this.signals.includes(id)) return;
      const of = axis === null ? "loop" : machine.axes[axis].name;
      if (!groups.has(of)) {
        const group = document.createElement("optgroup");
        group.label = of;
        groups.set(of, group);
      }
      groups.get(of).append(new Option(axis === null ? name : `${of} ${name}`, id));
    });
    add.append(...groups.values());
    add.disabled = this.signals.length >= MOST_SIGNALS;
    add.onchange = () => this.change([...this.signals, Number(add.value)]);
    const close = button("×", "Remove this plot", () => this.scope.removePlot(this));
    close.className = "close";
    this.values = chips.map((chip) => chip.querySelector("b"));
    this.head.replaceChildren(...chips, add, close);
  }

  change(signals) {
    this.signals = signals;
    this.scope.changed();
    this.build();
  }

  draw() {
    const { view } = this.scope;
    if (!this.uplot || Number.isNaN(view.from)) return;
    this.uplot.setData(drawn(view, this.signals, this.uplot.bbox.width / devicePixelRatio));
    this.readout();
  }

  /** The values under the pointer, or else the newest that are seen. */
  readout() {
    const { view } = this.scope;
    const { left } = this.uplot?.cursor ?? {};
    const isOver = left !== undefined && left >= 0;
    const time = isOver ? this.uplot.posToVal(left, "x") + view.origin : view.to;
    this.values.forEach((value, place) => {
      value.textContent = this.scope.textAt(this.signals[place], time);
    });
  }

  /** The trigger, events, and the cursors, over the samples. */
  marks(u) {
    const { view, trigger, cursors, events } = this.scope;
    const { ctx, bbox } = u;
    const x = (time) => u.valToPos(time - view.origin, "x", true);
    const line = (at, colour, dash) => {
      if (!(at >= bbox.left && at <= bbox.left + bbox.width)) return;
      ctx.strokeStyle = colour;
      ctx.setLineDash(dash.map((part) => part * devicePixelRatio));
      ctx.beginPath();
      ctx.moveTo(Math.round(at) + 0.5, bbox.top);
      ctx.lineTo(Math.round(at) + 0.5, bbox.top + bbox.height);
      ctx.stroke();
    };
    ctx.save();
    ctx.lineWidth = devicePixelRatio;
    for (const { t, fault } of events) {
      if (t < view.from || t > view.to) continue;
      ctx.fillStyle = css(fault ? "--bad" : "--dim");
      ctx.fillRect(x(t) - devicePixelRatio, bbox.top, 2 * devicePixelRatio, (fault ? 14 : 7) * devicePixelRatio);
    }
    if (view.triggered) line(x(view.origin), css("--warn"), [2, 3]);
    const place = this.signals.indexOf(trigger.source);
    if (!trigger.isOff && place >= 0) {
      const y = u.valToPos(trigger.level, u.series[place + 1].scale, true);
      if (y >= bbox.top && y <= bbox.top + bbox.height) {
        ctx.strokeStyle = css("--warn");
        ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
        ctx.beginPath();
        ctx.moveTo(bbox.left, y);
        ctx.lineTo(bbox.left + bbox.width, y);
        ctx.stroke();
      }
    }
    if (cursors.on) {
      ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
      ctx.textAlign = "left";
      for (const [name, at] of [
        ["A", cursors.a],
        ["B", cursors.b],
      ]) {
        line(x(at), css("--hold"), []);
        ctx.fillStyle = css("--hold");
        ctx.fillText(name, x(at) + 4 * devicePixelRatio, bbox.top + 12 * devicePixelRatio);
      }
    }
    ctx.restore();
  }

  select(u) {
    const { left, width } = u.select;
    if (width < 5) return;
    const { origin } = this.scope.view;
    const [from, to] = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.scope.zoom(from + origin, to + origin);
  }

  listen(over) {
    const share = (event) => event.offsetX / over.clientWidth;
    over.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.scope.zoomBy(event.deltaY > 0 ? 1.25 : 0.8, share(event));
      },
      { passive: false },
    );
    let down = null;
    over.addEventListener("pointerdown", (event) => {
      down = {
        at: event.offsetX,
        last: event.offsetX,
        pans: event.shiftKey || event.pointerType === "touch",
        moved: false,
      };
      if (down.pans) over.setPointerCapture(event.pointerId);
    });
    // A pan is no selection.
    over.addEventListener("mousedown", (event) => event.shiftKey && event.stopImmediatePropagation(), true);
    over.addEventListener("pointermove", (event) => {
      if (!down) return;
      down.moved ||= Math.abs(event.offsetX - down.at) > 4;
      if (down.pans && down.moved) {
        this.scope.pan((down.last - event.offsetX) / over.clientWidth);
        down.last = event.offsetX;
      }
    });
    over.addEventListener("pointerup", (event) => {
      if (down && !down.moved) {
        const { view } = this.scope;
        this.scope.setCursor(event.shiftKey ? "b" : "a", view.from + share(event) * (view.to - view.from));
      }
      down = null;
    });
    over.addEventListener("dblclick", () => this.scope.fit());
  }
}

export function button(text, about, act) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = text;
  button.title = button.ariaLabel = about;
  button.onclick = act;
  return button;
}
