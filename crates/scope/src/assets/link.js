// The websocket: opened again until the page is closed.

import { token } from "./token.js";

// A scope that answers does so sooner.
const PATIENCE = 2000;

const GONE = "the scope does not answer: is it still running?";

/** Why there is no websocket: a browser does not say why one was refused. */
async function refusal() {
  const named = token();
  const headers = named ? { Authorization: `Bearer ${named}` } : {};
  try {
    const answer = await fetch("access", { headers, cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
    return answer.ok ? GONE : `refused: ${(await answer.text()).trim()}`;
  } catch {
    return GONE;
  }
}

export class Link {
  constructor(on) {
    this.on = on;
    this.wanted = null;
    this.pause = 250;
    this.open();
    // Another token for the same page: a browser does not load it again.
    addEventListener("hashchange", () => {
      if (!location.hash.startsWith("#token=")) return;
      token();
      this.again();
    });
  }

  open() {
    const named = token();
    // The only header of it that a page can set.
    const socket = new WebSocket(`ws://${location.host}/ws`, ["fieldbeat", ...(named ? [named] : [])]);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    let isOpen = false;
    socket.onopen = () => {
      isOpen = true;
      this.pause = 250;
      if (this.wanted) this.send(this.wanted);
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.on.message(JSON.parse(data));
      else this.on.samples(data);
    };
    socket.onclose = async ({ code, reason }) => {
      this.on.closed(code === 1008 ? `refused: ${reason}` : isOpen ? GONE : await refusal());
      setTimeout(() => this.open(), this.pause);
      this.pause = Math.min(2 * this.pause, 4000);
    };
  }

  /** Shows these signals from now on, also on the next connection. */
  show(ids) {
    this.wanted = { show: [...ids] };
    this.send(this.wanted);
  }

  /** Ends this connection; the next one follows at once. */
  again() {
    this.socket.close();
  }

  /** Sends it; false: there is no connection. */
  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }
}
