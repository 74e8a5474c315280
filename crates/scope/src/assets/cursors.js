// Two cursors over all plots, and what lies between them. While samples come they keep their places on the screen.

import { digits, seconds } from "./plot.js";

const get = (id) => document.getElementById(id);

export class Cursors {
  constructor(scope) {
    this.scope = scope;
    this.on = false;
    this.a = this.b = this.from = NaN;
  }

  toggle() {
    const { from, to } = this.scope.view;
    this.on = !this.on;
    get("cursors").ariaPressed = this.on;
    get("measured").hidden = !this.on;
    if (!this.on) return;
    this.a = from + (to - from) / 3;
    this.b = from + ((to - from) * 2) / 3;
    this.from = from;
  }

  set(name, time) {
    if (!this.on) this.toggle();
    this[name] = time;
  }

  /** By a share of what is seen. */
  nudge(name, share) {
    if (!this.on) this.toggle();
    this[name] += share * (this.scope.view.to - this.scope.view.from);
  }

  /** Follows the view, and shows the values at both. */
  follow() {
    if (!this.on) return;
    const { view } = this.scope;
    const moved = view.from - this.from;
    if (!view.held && moved) {
      this.a += moved;
      this.b += moved;
    }
    this.from = view.from;
    if (!Number.isNaN(this.a)) this.measure();
  }

  /** The values at both and their differences, a row each below their heads. */
  rows() {
    const { scope, a, b } = this;
    const { origin } = scope.view;
    const apart = b - a;
    const rows = [
      ["", "A", "B", "B − A"],
      ["time", seconds(a - origin), seconds(b - origin), seconds(apart)],
      ["frequency", "", "", apart ? `${digits(1 / Math.abs(apart))} Hz` : "–"],
    ];
    for (const id of scope.drawn) {
      const apart = scope.valueAt(id, b) - scope.valueAt(id, a);
      const { unit } = scope.machine.signals[id];
      rows.push([scope.nameOf(id), scope.textAt(id, a), scope.textAt(id, b), `${digits(apart)} ${unit}`]);
    }
    return rows;
  }

  measure() {
    const table = document.createElement("table");
    for (const [place, cells] of this.rows().entries()) {
      const row = table.insertRow();
      cells.forEach((text, column) => {
        const cell = document.createElement(place && column ? "td" : "th");
        cell.textContent = text;
        if (column) cell.className = "n";
        row.append(cell);
      });
    }
    get("measured").replaceChildren(table);
  }
}
