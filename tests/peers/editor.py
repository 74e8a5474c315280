"""What an editor proposes in a configuration, by the language server tombi: prints the keys at the end of a file."""

import json
import os
import pathlib
import subprocess
import sys
import time

server = subprocess.Popen(
    [sys.argv[1], "lsp"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
)
path = pathlib.Path(sys.argv[2]).resolve()


def send(message):
    body = json.dumps({"jsonrpc": "2.0", **message}).encode()
    server.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
    server.stdin.flush()


def receive():
    length = 0
    while line := server.stdout.readline().strip():
        name, _, value = line.partition(b":")
        if name.lower() == b"content-length":
            length = int(value)
    return json.loads(server.stdout.read(length))


def request(number, method, params):
    send({"id": number, "method": method, "params": params})
    while True:
        message = receive()
        if "method" not in message and message.get("id") == number:
            return message["result"]
        if "method" in message and "id" in message:
            send({"id": message["id"], "result": None})


text = path.read_text()
folder = {"uri": path.parent.as_uri(), "name": "machine"}
request(1, "initialize", {"processId": os.getpid(), "capabilities": {}, "workspaceFolders": [folder]})
send({"method": "initialized", "params": {}})
document = {"uri": path.as_uri()}
opened = {**document, "languageId": "toml", "version": 1, "text": text}
send({"method": "textDocument/didOpen", "params": {"textDocument": opened}})
place = {"line": text.count("\n"), "character": 0}
# The schema is read meanwhile.
for number in range(2, 100):
    proposed = request(number, "textDocument/completion", {"textDocument": document, "position": place}) or []
    items = proposed["items"] if isinstance(proposed, dict) else proposed
    if items:
        break
    time.sleep(0.2)
for item in items:
    documentation = item.get("documentation") or {}
    said = documentation.get("value", "") if isinstance(documentation, dict) else documentation
    print(item["label"], json.dumps(said, ensure_ascii=False), sep="\t")
server.kill()
