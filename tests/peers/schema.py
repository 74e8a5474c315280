"""Judges configurations by the schema, with the library jsonschema: a line of JSON with the text of each."""

import json
import sys
import tomllib

from jsonschema import Draft7Validator

with open(sys.argv[1], encoding="utf-8") as file:
    schema = json.load(file)
Draft7Validator.check_schema(schema)
validator = Draft7Validator(schema)
print("ready", flush=True)
for line in sys.stdin:
    try:
        document = tomllib.loads(json.loads(line))
    except tomllib.TOMLDecodeError:
        print("no TOML", flush=True)
        continue
    places = [error.absolute_path for error in validator.iter_errors(document)]
    if places and all("defaults" in place for place in places):
        print("refused in defaults", flush=True)
    else:
        print("refused" if places else "valid", flush=True)
