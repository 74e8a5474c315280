// The token of the address. It stands behind the "#", which no browser sends to a server, and is taken out of the
// address at once, so that neither the history nor a copy of it has it. It is kept in the memory of this page alone.

let kept = null;

/** The token, if the page was opened with one. */
export function token() {
  const found = /^#token=([0-9a-f]+)$/.exec(location.hash);
  if (found) {
    kept = found[1];
    history.replaceState(null, "", location.pathname + location.search);
  }
  return kept;
}

token();
