// The station's page: what the server tells, in four views. Everything that comes from outside (names,
// reasons, notes) is set as text, never as markup.
"use strict";
(() => {
  const LANGUAGES = ["en", "de", "fr", "ja"];
  const SIGNS = { good: "✓", usable: "!", bad: "✗" };
  const ROWS = 3, COLUMNS = 4; // of a picture's cells, as station/board_tour.py has them
  const scans = new Map(), looks = new Map(), drawn = { job: "", kind: "" };
  let drawnRows = new WeakMap(); // of Today: all made anew at each event would load all pictures again
  let words = {}, capture = { state: "idle" }, rig = {}, hasRig = false, canCapture = false, current = "", stream = null, boards = null;

  const $ = (id) => document.getElementById(id);
  const say = (key, values = {}) => String(words[key] ?? key).replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
  const number = (value, digits = 1) => (value === null || value === undefined ? "–" : value.toLocaleString(words["#"], { minimumFractionDigits: digits, maximumFractionDigits: digits }));

  // What kind of reason it is, in the reader's language; its sentence with the figures is English.
  const explain = (text) => (words.kinds || []).find(([parts]) => parts.some((part) => text.includes(part)))?.[1];

  function tell(text) {
    const kind = explain(text), english = make("span", { lang: "en" }, text);
    return kind ? [make("strong", { lang: words["#"] }, kind), make("br"), english] : [english];
  }

  // Names of steps, and of what is drawn on a body.
  const term = (text) => words.terms?.[text] ?? (text.endsWith(" or more") ? say("orMore", { count: text.split(" ")[0] }) : text);

  function make(name, attributes = {}, ...inside) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) {
      if (value !== null && value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
    }
    made.append(...inside.filter((one) => one !== null));
    return made;
  }

  async function ask(path, body) {
    const options = body === undefined ? {} : { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) };
    const answer = await fetch(path, options);
    if (answer.status === 404) return null;
    const content = await answer.json().catch(() => ({ what: answer.statusText }));
    if (!answer.ok) throw new Error([content.what, content.remedy].filter(Boolean).join("\n"));
    return content;
  }

  const scanPath = (job, part = "") => `api/scans/${encodeURIComponent(job)}${part && `/${part}`}`;

  // -- Now

  function standing(row) {
    if (!row) return rig.id === null ? "uncalibrated" : "waiting";
    if (row.state === "set aside") return "aside";
    if (row.mark) return row.mark;
    return row.state === "running" ? "running" : "arriving";
  }

  function showNow() {
    const row = scans.get(current), key = standing(row);
    $("verdict").className = SIGNS[key] ? key : key === "aside" ? "bad" : "";
    $("mark").textContent = SIGNS[key] || (key === "aside" ? "✗" : "");
    $("grade").textContent = say(key) + (SIGNS[key] && !row.final ? ` (${say("sofar")})` : "");
    $("what-to-do").textContent = say(`${key}What`);
    const reasons = !row ? [] : row.state === "set aside" ? [row.reason] : row.reasons || [];
    $("reasons").replaceChildren(...reasons.filter(Boolean).map((text) => make("li", {}, ...tell(text))));
    $("in-english").hidden = words["#"] === "en" || !reasons.length;
    const working = row && row.state !== "done" && row.state !== "set aside" && row.part;
    $("stage").textContent = working ? `${term(row.part)} ${row.total ? `${row.done}/${row.total}` : ""}` : "";
    $("whose").textContent = !row ? "" : row.body ? say("body", { job: row.subject || row.job }) : say("noBody");
    document.querySelector("#body canvas").setAttribute("aria-label", $("whose").textContent || say("noBody"));
    $("decide").hidden = !row || !(row.final || row.state === "done" || row.state === "set aside");
    for (const button of document.querySelectorAll("[data-decision]")) {
      button.setAttribute("aria-pressed", Boolean(row) && row.decision === button.dataset.decision);
    }
    if (row && document.activeElement !== $("note")) $("note").value = row.note || "";
    showPairs(row);
    showBody(row);
  }

  function showPairs(row) {
    const pairs = row ? Object.entries(row.pairs || {}) : [];
    $("pairs-title").hidden = !pairs.length;
    $("pairs").replaceChildren(...pairs.map(([name, [have, total]]) => {
      const look = looks.get(`${row.job}/${name}`), complete = have === total;
      if (complete && look === undefined) lookAt(row.job, name);
      const image = look ? make("img", { src: `data:image/jpeg;base64,${look.picture}`, alt: "" }) : make("div", { class: "none", role: "img", "aria-label": say("noPicture") });
      const lines = [make("div", {}, say("images", { have, total }))];
      if (look) {
        const percent = Math.round(100 * look.bright);
        lines.push(make("div", { class: percent < 25 ? "warn" : null }, say("bright", { percent }) + (percent < 25 ? ` – ${say("tooDark")}` : "")));
        if (look.saturated > 0.01) lines.push(make("div", { class: "warn" }, `! ${say("saturated", { percent: number(100 * look.saturated) })}`));
      }
      return make("li", {}, make("div", { class: "name" }, name, make("span", { "aria-hidden": "true" }, complete ? "✓" : "…")), image, ...lines);
    }));
  }

  async function lookAt(job, pair) {
    looks.set(`${job}/${pair}`, null);
    const seen = await ask(scanPath(job, `pairs/${encodeURIComponent(pair)}`)).catch(() => null);
    looks.set(`${job}/${pair}`, seen);
    if (job === current && seen) showPairs(scans.get(job));
  }

  // A figure is shown anew with a fresh canvas: so the picture of the person before is gone at once. A
  // person's cloud stays until the mesh is there.
  async function showBody(row) {
    const job = row ? row.job : "", kind = (row && row.body) || "";
    if (drawn.job === job && drawn.kind === kind) return;
    const isSame = drawn.job === job && Boolean(kind);
    Object.assign(drawn, { job, kind });
    $("body").classList.toggle("empty", !kind);
    if (!isSame) clearBody();
    if (!kind) return;
    const model = await ask(scanPath(job, "body")).catch(() => null);
    if (!model || drawn.job !== job || drawn.kind !== kind) return;
    if (isSame) clearBody();
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) $("body").dataset.turning = "1";
    window.showModel($("body"), translate(model));
  }

  function translate(model) {
    model.failed = say("noWebgl");
    for (const layer of model.layers) {
      layer.name = term(layer.name);
      if (layer.legend?.caption) layer.legend.caption = term(layer.legend.caption);
      for (const swatch of layer.legend?.swatches || []) swatch[1] = term(swatch[1]);
    }
    return model;
  }

  function clearBody() {
    const figure = $("body"), old = figure.querySelector("canvas"), label = old.getAttribute("aria-label");
    const lost = old.getContext("webgl");
    if (lost) lost.getExtension("WEBGL_lose_context")?.loseContext();
    old.replaceWith(make("canvas", { tabindex: "0", "aria-label": label }));
    for (const name of ["labels", "layers", "legend"]) figure.querySelector(`.${name}`).replaceChildren();
    figure.querySelector(".failed")?.remove();
  }

  function showCapture() {
    $("start").hidden = !canCapture || rig.id === null;
    $("board").hidden = !canCapture;
    const busy = !["idle", "failed"].includes(capture.state);
    for (const button of [$("start").querySelector("button"), $("board"), $("calibrate")]) button.disabled = busy;
    $("taking").hidden = capture.state !== "taking";
    if (capture.total) $("taking").value = capture.done / capture.total;
    const lost = Object.entries(capture.lost || {}).map(([pair, reason]) => say("lostFrames", { pair, reason }));
    const part = capture.state === "calibrating" && capture.part ? `: ${term(capture.part)} ${capture.done}/${capture.total}` : "";
    const made = capture.calibrated ? say("calibrated", { verdict: say(capture.calibrated) }) : capture.lost ? say("taken") : "";
    const text = capture.state === "idle" ? made : say(capture.state, { ...capture, reason: "" }) + part;
    const english = [capture.state === "failed" && capture.reason, ...lost, ...(capture.reasons || [])].filter(Boolean);
    for (const id of ["capture", "board-capture"]) $(id).replaceChildren(text, ...english.flatMap((one) => [make("br"), ...tell(one)]));
  }

  async function decide(decision) {
    const job = current, before = scans.get(job);
    if (!before) return;
    if (decision === "discard" && !(await confirmed(say("askDiscard", { job }), "discard"))) return;
    try {
      take(await ask(scanPath(job), { decision, note: $("note").value }));
      if (decision === "repeat") { $("subject").value = before.subject || ""; $("subject").focus(); }
    } catch (error) { complain(error); }
  }

  function confirmed(question, yes) {
    $("question").textContent = question;
    $("yes").textContent = say(yes);
    $("yes").className = yes === "discard" ? "danger" : "";
    const dialog = $("ask");
    dialog.returnValue = "no";
    dialog.showModal();
    return new Promise((done) => dialog.addEventListener("close", () => done(dialog.returnValue === "yes"), { once: true }));
  }

  function complain(error) {
    $("trouble").replaceChildren(...tell(error.message || String(error)));
    $("trouble").hidden = false;
  }

  // -- Today

  const WORST = { aside: 0, bad: 1, usable: 2, good: 3 };
  const ORDERS = {
    newest: () => 0,
    byName: (a, b) => a.job.localeCompare(b.job),
    bySway: (a, b) => (b.sway_mm ?? -1) - (a.sway_mm ?? -1),
    byGrade: (a, b) => (WORST[standing(a)] ?? 4) - (WORST[standing(b)] ?? 4),
  };

  function showToday() {
    if ($("today").hidden) return;
    const rows = [...scans.values()].reverse(), wanted = $("search").value.toLowerCase(), shown = $("filter").value;
    const counts = { done: 0, waiting: 0, failed: 0 };
    for (const row of rows) counts[row.state === "done" ? "done" : row.state === "set aside" ? "failed" : "waiting"] += 1;
    $("counts").textContent = rows.length ? say("counts", counts) : say("nothing");
    $("measures").hidden = !counts.done;
    const found = rows.filter((row) => (!shown || standing(row) === shown || row.decision === shown) && [row.job, row.subject, row.note, ...(row.reasons || [])].join(" ").toLowerCase().includes(wanted));
    found.sort(ORDERS[$("sort").value] || ORDERS.newest);
    const names = ["", "scan", "verdict", "sway", "breath", "covered", "stature", "chest", "waist", "hip", ""];
    document.querySelector("#rows thead").replaceChildren(make("tr", {}, ...names.map((key) => (key ? make("th", { scope: "col" }, say(key)) : make("td")))));
    document.querySelector("#rows tbody").replaceChildren(...found.map((row) => drawnRows.get(row) || drawnRows.set(row, todayRow(row)).get(row)));
  }

  function todayRow(row) {
    const key = standing(row), why = row.state === "set aside" ? row.reason : (row.reasons || [])[0];
    const figure = (name, value, digits) => make("td", { class: "number", "data-name": say(name) }, typeof value === "string" ? value.replace("-", "–") : number(value, digits));
    const picture = row.state === "done" ? make("img", { src: scanPath(row.job, "picture"), alt: "", loading: "lazy" }) : null;
    const decided = row.decision ? ` · ${say(row.decision)}` : "";
    return make("tr", { class: row.decision === "discard" ? "discard" : null },
      make("td", {}, picture),
      make("td", { class: "job" }, make("strong", {}, row.job), make("div", { class: "why" }, [row.subject !== row.job && row.subject, row.note].filter(Boolean).join(" · "))),
      make("td", { class: "verdict" }, make("span", { class: `badge ${SIGNS[key] ? key : key === "aside" ? "bad" : ""}` }, `${SIGNS[key] || (key === "aside" ? "✗" : "…")} ${say(key)}`), decided, why ? make("div", { class: "why", lang: explain(why) ? words["#"] : "en", title: why }, explain(why) || why) : null),
      figure("sway", row.sway_mm), figure("breath", row.breath_mm), figure("covered", row.coverage_percent), figure("stature", row.stature_mm, 0),
      figure("chest", row.chest_mm, 0), figure("waist", row.waist_mm, 0), figure("hip", row.hip_mm, 0),
      make("td", {}, row.body === "mesh" ? make("a", { href: scanPath(row.job, "report"), target: "_blank", rel: "noopener" }, say("report")) : ""));
  }

  // -- Rig

  async function showRig() {
    if ($("rig").hidden) return;
    const series = await ask("api/rig").catch(complain);
    if (!series) return;
    const days = Math.floor((Date.now() - Date.parse(rig.written)) / 864e5);
    $("calibration").textContent = rig.id ? say("inUse", { ...rig, days, pairs: rig.pairs.length }) : say("uncalibratedWhat");
    const lasts = Object.entries(series).map(([pair, points]) => [pair, points[points.length - 1]]);
    const moved = lasts.filter(([, point]) => point.moved).map(([pair]) => pair);
    $("moved").textContent = moved.length ? say("moved", { pairs: moved.join(", ") }) : lasts.length ? say("steady") : say("few");
    $("axis").textContent = lasts.length ? say("driftAxis") : "";
    $("series").replaceChildren(...Object.entries(series).map(([pair, points]) => driftChart(pair, points)));
  }

  function driftChart(pair, points) {
    const NS = "http://www.w3.org/2000/svg", width = 320, height = 150, left = 34, bottom = 18;
    const part = (name, attributes, text = "") => {
      const made = document.createElementNS(NS, name);
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      made.textContent = text;
      return made;
    };
    const top = Math.max(...points.map((p) => Math.max(p.mm + (p.sigma_mm || 0), Math.min(p.limit_mm, 3 * p.mm + 1))), 0.5);
    const x = (k) => left + ((k + 0.5) * (width - left - 6)) / points.length, y = (mm) => height - bottom - ((height - bottom - 8) * mm) / top;
    const last = points[points.length - 1], title = say("drift", { pair, mm: number(last.mm, 2), sigma: number(last.sigma_mm, 2) });
    const svg = part("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
    svg.append(part("line", { class: "axis", x1: left, x2: width, y1: y(0), y2: y(0) }));
    for (const mm of [0, top / 2, top]) svg.append(part("text", { x: 2, y: y(mm) + 4 }, number(mm, 1)));
    if (last.limit_mm <= top) svg.append(part("line", { class: "limit", x1: left, x2: width, y1: y(last.limit_mm), y2: y(last.limit_mm) }));
    points.forEach((p, k) => {
      const spread = p.sigma_mm || 0;
      svg.append(part("line", { class: "error", x1: x(k), x2: x(k), y1: y(p.mm + spread), y2: y(Math.max(p.mm - spread, 0)) }));
      const mark = p.moved ? part("rect", { class: "point moved", x: x(k) - 4, y: y(p.mm) - 4, width: 8, height: 8 }) : part("circle", { class: "point", cx: x(k), cy: y(p.mm), r: 3.5 });
      mark.append(part("title", {}, `${p.job}: ${number(p.mm, 2)} mm`));
      svg.append(mark);
    });
    return make("figure", {}, make("strong", {}, title), svg);
  }

  // -- Calibrating

  async function openBoards() {
    if ($("calibrating").hidden) return;
    if (!hasRig) { $("hold").textContent = say("noRig"); return; }
    try { boards = await ask("api/boards"); showBoards(); } catch (error) { complain(error); }
  }

  function showBoards() {
    if (!boards || $("calibrating").hidden) return;
    const next = boards.next, place = "row" in next ? words.places[next.row * COLUMNS + next.column] : "";
    const list = (names) => [names || []].flat().join(", ");
    $("calibrate").hidden = boards.shots < 3;
    $("calibrate").classList.toggle("main", next.say === "enough");
    $("board").classList.toggle("main", next.say !== "enough");
    const pair = (next.pair || "").replaceAll("-", "\u2011"); // not broken at its hyphen
    $("hold").textContent = say(next.say, { ...next, pair, place, one: list(next.one), other: list(next.other) });
    $("missed").textContent = boards.missed.length ? say("missed", { shot: boards.last, pairs: list(boards.missed) }) : "";
    $("covered").replaceChildren(...boards.pairs.map((pair) => {
      const cells = make("div", { class: "cells", "aria-hidden": "true" });
      cells.style.gridTemplate = `repeat(${ROWS}, 1fr) / repeat(${COLUMNS}, 1fr)`;
      pair.cells.forEach((count, k) => {
        const wanted = next.pair === pair.name && k === next.row * COLUMNS + next.column;
        cells.append(make("span", { class: [count ? "seen" : "", wanted ? "wanted" : ""].join(" ").trim() }, count || ""));
      });
      const enough = pair.boards >= boards.wanted ? "✓" : "";
      return make("li", {}, make("div", { class: "name" }, pair.name, make("span", { "aria-hidden": "true" }, enough)), cells,
        make("div", {}, say("boardsSeen", { count: pair.boards, wanted: boards.wanted })),
        make("div", {}, pair.sigma_mm ? say("sigma", { mm: number(pair.sigma_mm, 3) }) : " "));
    }));
    const names = boards.pairs.map((pair) => pair.name), counts = new Map(boards.shared.flatMap(([a, b, n]) => [[`${a}/${b}`, n], [`${b}/${a}`, n]]));
    const head = make("tr", {}, make("td"), ...names.map((name) => make("th", { scope: "col" }, name)));
    $("shared").replaceChildren(head, ...names.map((a) => make("tr", {}, make("th", { scope: "row" }, a), ...names.map((b) => make("td", { class: "number" }, a === b ? "" : String(counts.get(`${a}/${b}`) || 0))))));
    $("advice").replaceChildren(...boards.advice.map((line) => make("li", {}, ...tell(line))));
  }

  // Without a question where it can do no harm.
  async function calibrate() {
    const harmless = rig.id === null && boards.next.say === "enough";
    if (harmless || (await confirmed(say("askCalibrate", boards), "calibrate"))) ask("api/calibrate", {}).catch(complain);
  }

  // -- events

  function take(row) {
    const before = scans.get(row.job);
    scans.delete(row.job);
    scans.set(row.job, row);
    const begun = (one) => one?.state === "arriving" && Object.keys(one.pairs).length > 0; // not a folder of rubbish
    if (begun(row) && !begun(before)) {
      for (const key of looks.keys()) looks.delete(key); // a retake has other pictures, the day many
      current = row.job;
    }
    // Not by what is still done for the person before.
    if (row.state === "running" && before?.state !== "running" && begun({ ...row, state: "arriving" })) current = row.job;
    const shown = row.job === current;
    if (shown && row.decision === "discard" && before?.decision !== "discard") current = "";
    if (shown) showNow();
    showToday();
    if (row.final && !before?.final) showRig();
  }

  function hear(event) {
    if (event.kind === "scan") take(event.row);
    if (event.kind === "rig") connect(); // another calibration is in use
    if (event.kind === "boards") { boards = event; showBoards(); }
    if (event.kind === "trouble") complain({ message: event.text });
    if (event.kind === "exposure") $("capture").append(make("br"), ...tell(event.text));
    if (event.kind === "capture") {
      capture = event;
      if (event.state === "asked") { current = ""; showNow(); }
      showCapture();
    }
  }

  function online(yes) {
    $("line").textContent = say(yes ? "connected" : "lost");
    $("line").classList.toggle("lost", !yes);
  }

  async function connect() {
    stream?.close();
    try {
      const state = await ask("api/state");
      scans.clear();
      for (const row of state.rows) scans.set(row.job, row);
      ({ capture, rig, has_rig: hasRig, can_capture: canCapture } = state);
      const unfinished = state.rows.filter((row) => row.state === "running" || (row.state === "arriving" && Object.keys(row.pairs).length));
      const last = unfinished[unfinished.length - 1] || state.rows[state.rows.length - 1];
      current = last && last.decision !== "discard" ? last.job : "";
      $("trouble").hidden = true;
      if (state.trouble) complain({ message: state.trouble });
      document.title = `${rig.name} – bodyscan`;
      showAll();
      stream = new EventSource(`api/events?after=${state.number}`);
      stream.onopen = () => online(true);
      stream.onmessage = (message) => hear(JSON.parse(message.data));
      stream.addEventListener("anew", connect);
      stream.onerror = () => { online(false); if (stream.readyState === 2) setTimeout(connect, 1500); };
    } catch {
      online(false);
      setTimeout(connect, 1500);
    }
  }

  // -- words and views

  function showAll() {
    showCapture();
    showNow();
    showToday();
    showRig();
    showBoards();
  }

  async function speak(language) {
    words = await (await fetch(`languages/${language}.json`)).json();
    drawnRows = new WeakMap();
    words["#"] = language;
    document.documentElement.lang = language;
    for (const element of document.querySelectorAll("[data-say]")) element.textContent = say(element.dataset.say);
    const choices = (id, keys) => {
      const chosen = $(id).value;
      $(id).replaceChildren(...keys.map(([value, key]) => make("option", { value, selected: value === chosen }, say(key))));
    };
    choices("filter", [["", "all"], ["good", "good"], ["usable", "usable"], ["bad", "bad"], ["aside", "aside"], ["keep", "keep"], ["discard", "discard"]]);
    choices("sort", Object.keys(ORDERS).map((key) => [key, key]));
    try { localStorage.setItem("language", language); } catch { /* a private window */ }
  }

  function show() {
    const names = ["now", "today", "rig", "calibrating"], wanted = names.includes(location.hash.slice(1)) ? location.hash.slice(1) : "now";
    for (const name of names) $(name).hidden = name !== wanted;
    for (const link of document.querySelectorAll("nav a")) {
      if (link.hash === `#${wanted}`) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    showToday();
    showRig();
    openBoards();
    window.scrollTo(0, 0);
  }

  async function begin() {
    let kept = null;
    try { kept = localStorage.getItem("language"); } catch { /* a private window */ }
    const wanted = [kept, ...navigator.languages.map((one) => one.slice(0, 2))].find((one) => LANGUAGES.includes(one)) || "en";
    const titles = { en: "English", de: "Deutsch", fr: "Français", ja: "日本語" };
    $("language").append(...LANGUAGES.map((one) => make("option", { value: one, lang: one, selected: one === wanted }, titles[one])));
    await speak(wanted);
    $("language").addEventListener("change", async () => { await speak($("language").value); drawn.kind = " "; /* a body is drawn again, in the new language */ online(stream?.readyState === 1); showAll(); });
    for (const id of ["search", "filter", "sort"]) $(id).addEventListener("input", showToday);
    document.querySelector(".bar").addEventListener("submit", (event) => event.preventDefault());
    for (const button of document.querySelectorAll("[data-decision]")) button.addEventListener("click", () => decide(button.dataset.decision));
    $("note").addEventListener("change", () => decide(scans.get(current)?.decision ?? null));
    $("start").addEventListener("submit", (event) => {
      event.preventDefault();
      ask("api/start", { subject: $("subject").value.trim() }).catch(complain);
    });
    $("board").addEventListener("click", () => ask("api/board", {}).catch(complain));
    $("calibrate").addEventListener("click", calibrate);
    $("trouble").addEventListener("click", () => { $("trouble").hidden = true; });
    window.addEventListener("hashchange", show);
    show();
    await connect();
    openBoards();
  }

  begin();
})();
