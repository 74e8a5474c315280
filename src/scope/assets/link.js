// The websocket: opened again until the page is closed.

export class Link {
  constructor(on) {
    this.on = on;
    this.wanted = null;
    this.pause = 250;
    this.open();
  }

  open() {
    const socket = new WebSocket(`ws://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.pause = 250;
      if (this.wanted) this.send(this.wanted);
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === "string") this.on.message(JSON.parse(data));
      else this.on.samples(data);
    };
    socket.onclose = ({ code, reason }) => {
      const why = code === 1008 ? `refused: ${reason}` : "the scope does not answer: is it still running?";
      this.on.closed(why);
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
