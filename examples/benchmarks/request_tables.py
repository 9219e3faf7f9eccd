"""Tables of the answers to requests: by kind, by repository, by cause, and the slopes of derivatives on differences."""

import re
import statistics
from collections import Counter, defaultdict

from request_draw import KINDS

from warp_psdr.coverage import FRAME, METHOD

#: Answers of a comparison; the request was taken.
COMPARED = ("right", "noisy", "zero", "one-sided", "wrong")
TAKEN = ("taken", "at a bound", *COMPARED)
REFUSED = ("refused", "planned, then refused")
#: Names in a sentence: quoted, and those of parameters.
QUOTED = re.compile(r"(?<!\w)'[^']*'(?:(?:, | and )'[^']*')*(?!\w)")
DOTTED = re.compile(r"\b[\w-]+(?:\.[\w-]+)*\.(?:\w+_\w+|data|value|position|direction|grid|scale)\b")
BY_KIND, BY_CAUSE, BY_REPOSITORY = "Requests by kind", "Refusals by cause", "Requests by repository"
CRASHES, SLOPES, SLOPES_BY_KIND = "Requests that crashed", "Slopes by request", "Slopes by kind"


def cause(sentence: str) -> str:
    """Return a refusal without its frame, its names and its remedy: what is the same wherever it is met."""
    text = METHOD.sub("it ", FRAME.sub("", sentence))
    text = DOTTED.sub("…", QUOTED.sub("…", text))
    return re.split(r"; |: (?=hold|give|use|set)", text)[0].strip()


def tables(rows: list[dict]) -> dict[str, list[dict]]:
    """Return the rows of each table by its title; those without rows are left out."""
    scenes = {row["file"]: row for row in rows if row["kind"] == "scene"}
    answers = sorted((row for row in rows if row["kind"] == "request"), key=lambda row: row["result"] in COMPARED)
    requests = list({(row["file"], row["name"]): row for row in answers}.values())
    found = {
        BY_KIND: _by_kind(requests),
        BY_CAUSE: _by_cause(requests),
        BY_REPOSITORY: _by_repository(requests, scenes),
        CRASHES: [
            {"file": r["file"], "parameter": r.get("name", ""), "how": r["why"]}
            for r in (*scenes.values(), *requests)
            if r["result"] == "crashed"
        ],
        SLOPES_BY_KIND: _slopes_by_kind(requests),
        SLOPES: [_slope(r) for r in requests if r["result"] in COMPARED],
    }
    return {title: of_it for title, of_it in found.items() if of_it}


def _share(requests: list[dict]) -> float:
    """Return how many percent of requests are taken."""
    return round(100.0 * sum(r["result"] in TAKEN for r in requests) / max(len(requests), 1), 1)


def _grouped(requests: list[dict], key: str) -> dict[str, list[dict]]:
    found = defaultdict(list)
    for row in requests:
        found[row[key]].append(row)
    return dict(found)


def _by_kind(requests: list[dict]) -> list[dict]:
    result = []
    kinds = _grouped(requests, "what")
    for title, held in [(k, kinds[k]) for k in KINDS if k in kinds] + [("all", requests)] * bool(requests):
        answers = Counter(r["result"] for r in held)
        scenes = _grouped(held, "file").values()
        counts = {"taken": sum(answers[a] for a in TAKEN), "refused": sum(answers[a] for a in REFUSED)}
        counts["crashed"] = answers["crashed"]
        none = sum(not any(r["result"] in TAKEN for r in scene) for scene in scenes)
        result.append({"by": title, "scenes": len(scenes), "scenes without any": none, "requests": len(held), **counts,
                       "taken, %": _share(held)})  # fmt: skip
    return result


def _by_cause(requests: list[dict]) -> list[dict]:
    refused = [r | {"cause": cause(r["why"])} for r in requests if r["result"] in REFUSED]
    result = []
    for title, held in sorted(_grouped(refused, "cause").items(), key=lambda item: -len(item[1])):
        kinds = Counter(r["what"] for r in held)
        by = ", ".join(f"{kind} {kinds[kind]}" for kind in KINDS if kinds[kind])
        files = list(dict.fromkeys(r["file"] for r in held))
        result.append({"cause": title, "requests": len(held), "scenes": len(files), "by": by, "as in": files[0]})
    return result


def _by_repository(requests: list[dict], scenes: dict[str, dict]) -> list[dict]:
    result = []
    for repository in dict.fromkeys(file.partition("/")[0] for file in scenes):
        files = [row for file, row in scenes.items() if file.partition("/")[0] == repository]
        held = [r for r in requests if r["file"].partition("/")[0] == repository]
        loaded = sum(row["result"] == "done" for row in files)
        result.append({"repository": repository, "files": len(files), "loaded": loaded, "requests": len(held),
                       "taken, %": _share(held) if held else None})  # fmt: skip
    return result


def _slopes_by_kind(requests: list[dict]) -> list[dict]:
    result = []
    for kind in KINDS:
        held = [r for r in requests if r["what"] == kind and (r["result"] in COMPARED or "cold" in r)]
        if not held:
            continue
        answers = Counter(r["result"] for r in held)
        seconds = {f"{call}, s": round(statistics.median(r[call] for r in held), 2)
                   for call in ("cold", "second", "warm", "image")}  # fmt: skip
        result.append({"by": kind, "compared": len(held)} | {a: answers[a] for a in COMPARED} | seconds)
    return result


def _slope(row: dict) -> dict:
    """Return a row on one comparison; processor seconds of the first three calls and of an image, at equal samples."""
    numbers = {"slope": row.get("slope"), "error": row.get("error"), "twice the step": row.get("wide")}
    seconds = {f"{call}, s": round(row[call], 2) for call in ("cold", "second", "warm", "image")}
    about = {"file": row["file"], "parameter": row["name"], "by": row["what"], "result": row["result"]}
    return (
        about
        | {k: None if v is None else round(v, 3) for k, v in numbers.items()}
        | {"batches": row["batches"]}
        | seconds
    )
