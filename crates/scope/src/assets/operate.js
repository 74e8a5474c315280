// The commands of this page: one request after the other, each when the one before was answered; a stop is sent at
// once, whatever is not answered yet: answers come behind all that this page has not read. While the page is
// the operator it asks for the state again and again: when it falls silent, the master stops the axes and switches
// them off.

const BEAT = 250;
// Between two stops: a key that is held down repeats its click, and the scope takes no flood.
const STOP_AFTER = 100;
const get = (id) => document.getElementById(id);

export class Operate {
  constructor(link) {
    this.link = link;
    this.waiting = [];
    this.underWay = [];
    this.stoppedAt = -Infinity;
    this.isOperator = false;
    this.since = 0;
    this.name = `page ${Math.random().toString(36).slice(2, 6)}`;
    this.facts = [];
    get("take").onclick = () => (this.isOperator ? this.leave() : this.take());
    get("stop").onclick = () => this.stop();
    for (const key of document.querySelectorAll("[data-order]")) key.onclick = () => this.command(key.dataset.order);
    for (const key of document.querySelectorAll("[data-step]")) key.onclick = () => this.step(Number(key.dataset.step));
    get("operated").onchange = () => this.choose();
    // Whoever does not see the machine does not move it. Browsers slow down the clock of a hidden page, too.
    document.addEventListener("visibilitychange", () => document.hidden && this.isOperator && this.leave());
    setInterval(() => this.isOperator && !this.underWay.length && this.ask({ state: { since: this.since } }), BEAT);
  }

  /** Whether this page may command. */
  allow(isAllowed) {
    get("operate").hidden = get("stop").hidden = !isAllowed;
    get("access").textContent = isAllowed ? "control" : "read-only";
    get("access").title = isAllowed ? "This page can command the machine" : "This page cannot command the machine";
    this.lost();
  }

  /** The connection, or the role, is gone. */
  lost() {
    [this.waiting, this.underWay, this.stoppedAt, this.isOperator] = [[], [], -Infinity, false];
    this.show();
  }

  take() {
    // A master that was started again counts its notices from the begin.
    this.since = 0;
    this.ask({ take: { name: this.name } });
    this.ask("axes", ({ axes }) => {
      const chosen = this.facts[Number(get("operated").value)]?.name;
      this.facts = axes;
      get("operated").replaceChildren(...axes.map(({ name }, index) => new Option(name, index)));
      get("operated").value = Math.max(axes.findIndex(({ name }) => name === chosen), 0);
      this.choose();
      this.isOperator = true;
      this.show();
    });
  }

  /** Another connection is no operator; what this one left is stopped and switched off. */
  leave() {
    this.link.again();
  }

  choose() {
    const of = this.facts[Number(get("operated").value)];
    if (!of) return;
    get("distance-unit").textContent = of.unit;
    const lacks = { enable: of.lacks.enable, disable: of.lacks.enable, home: of.lacks.home };
    for (const key of document.querySelectorAll("[data-order]")) {
      const why = lacks[key.dataset.order];
      key.disabled = Boolean(why);
      key.title = why ?? "";
    }
    for (const key of document.querySelectorAll("[data-step]")) {
      key.disabled = Boolean(of.lacks.step);
      key.title = of.lacks.step ?? "";
    }
  }

  command(command) {
    // A key that is held down repeats its click: what it has given by then would go on after it was let go.
    const isHeld = [...this.underWay, ...this.waiting].some(({ request }) => request.act);
    if (isHeld && command !== "disable") return;
    this.ask({ act: { command: { axis: Number(get("operated").value), command } } });
  }

  step(sign) {
    const distance = sign * Math.abs(Number(get("distance").value));
    const { velocity } = this.facts[Number(get("operated").value)];
    if (distance) this.command({ move: { target: { by: distance }, velocity } });
  }

  ask(request, then) {
    this.waiting.push({ request, then });
    this.next();
  }

  stop() {
    // Nothing that was asked before follows it. It does not wait for the answer to an earlier one, which may be long on
    // its way: what that has stopped may move again.
    this.waiting = [];
    const now = performance.now();
    if (now - this.stoppedAt < STOP_AFTER) return;
    this.stoppedAt = now;
    this.send({ request: "stop" });
  }

  next() {
    if (!this.underWay.length && this.waiting.length) this.send(this.waiting.shift());
  }

  send(asked) {
    this.underWay.push(asked);
    if (this.link.send({ operate: asked.request })) return;
    const what = asked.request === "stop" ? "the stop was NOT sent" : "nothing was sent";
    this.lost();
    get("notice").textContent = `no connection to the scope: ${what}`;
  }

  answer({ ok, error }) {
    const { then } = this.underWay.shift() ?? {};
    if (error) {
      // A refusal stops the axes: nothing that was asked before follows it. The state says who operates.
      this.waiting = [];
      get("notice").textContent = error;
    } else {
      then?.(ok);
      if (ok.state) this.state(ok.state);
    }
    this.show();
    this.next();
  }

  state({ operator, notices }) {
    get("operator").textContent = operator ? `by ${operator}` : "";
    if (operator !== this.name) this.isOperator = false;
    for (const { number, axis, text } of notices) {
      this.since = Math.max(this.since, number);
      get("notice").textContent = axis === null ? text : `${this.facts[axis]?.name ?? axis}: ${text}`;
    }
  }

  show() {
    get("orders").hidden = !this.isOperator;
    get("take").textContent = this.isOperator ? "Leave: stop and switch off" : "Take control";
    if (!this.isOperator) get("operator").textContent = "";
  }
}
