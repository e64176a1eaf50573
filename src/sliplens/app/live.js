// Number, picture, chart and lamps of a running sensor, drawn from messages of a binary websocket.
//
// A message is JSON (feed.py, `_message`), with a JPEG and the cells of a map in base 64 where they are new. The first
// one holds the settings. What was drawn is answered by its serial number; who does not answer is sent no more than two
// messages, so that nobody waits for a slow or hidden window.

const QUIET_MS = 3000; // without a message, after which nothing shown can be believed
const RETRY_MS = 1000;
const TOLD_MS = 200; // between two drawings of chart, lamps and facts: numbers that change faster nobody reads
const HAND_MS = 1000; // for which a slider stays where a person has put it
const NOTICE_MS = 10000;
const LOWERS = [230, 159, 0], RAISES = [86, 180, 233]; // as live.css has them
// Zones of sliplens/live/reading.py, each with a sign beside its colour.
const SIGNS = { none: "", below: "▼", uncertain: "?", within: "●", "not below": "●", above: "▲" };
const KEYS = { r: "reference", n: "object", f: "freeze", e: "explain", c: "record" };

const $ = Object.fromEntries([...document.querySelectorAll("[id]")].map((element) => [element.id, element]));
const sliders = [...document.querySelectorAll("[type=range]")];
const lamps = new Map();
let socket, settings, update, image, facts, map, mapFacts;
let points = [], owed = [];
let heardAt = performance.now(), saidAt = 0, toldAt = -TOLD_MS;
let scheduled = false, hasNewPicture = false;

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss:" : "ws:"}//${location.host}/readings`);
  socket.binaryType = "arraybuffer";
  let turn = Promise.resolve(); // pictures are decoded one after another
  // one that cannot be read is passed over: those after it are still taken
  socket.onmessage = ({ data }) => (turn = turn.then(() => take(data)).catch(console.error));
  socket.onclose = () => {
    owed = [];
    withdraw("no connection to sliplens: it has stopped, or the network is down");
    setTimeout(connect, RETRY_MS);
  };
}

function send(message) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

async function take(data) {
  const header = JSON.parse(new TextDecoder().decode(data));
  if (header.settings) return begin(header.settings);
  const hadMap = Boolean(map);
  if (header.picture) {
    const before = image;
    image = await createImageBitmap(new Blob([bytes(header.picture.jpeg)], { type: "image/jpeg" }));
    facts = header.picture;
    before?.close();
  }
  if (header.map) {
    map = paintMap(header.map, new Int8Array(bytes(header.map.cells).buffer));
    mapFacts = header.map;
  } else if (!header.has_map) {
    map = mapFacts = null;
  }
  hasNewPicture ||= Boolean(header.picture || header.map) || hadMap !== Boolean(map);
  points.push(...header.points);
  while (points.length && points[0].at_s < header.now_s - settings.chart_s) points.shift();
  header.notices.forEach(notify);
  update = header;
  heardAt = performance.now();
  owed.push({ act: "drawn", serial: header.serial });
  schedule();
}

function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

function begin(told) {
  settings = told;
  points = [];
  map = mapFacts = null;
  document.body.classList.toggle("bare", !settings.network);
  const [low, high] = settings.target;
  place(".zone", low, high);
  $.gauge.querySelector(".goal").style.left = `${50 * (low + high)}%`;
  for (const slider of sliders) {
    const most = settings.largest[slider.closest("#gripper") && slider.name === "pull_n" ? "grip_pull_n" : slider.name];
    Object.assign(slider, { min: 0, max: most, step: most / 60 });
  }
  if (!$.method.length) {
    $.method.append(...Object.entries(settings.methods).map(([name, title]) => new Option(title, name)));
    $.method.value = settings.recommended;
    $.controller.append(...settings.controllers.map((name) => new Option(name)));
  }
  document.querySelector("[data-act=record]").title = `every frame into ${settings.record_into}`;
  show();
}

function show() {
  send({ act: "show", map: $.map.checked });
}

function paintMap({ shape: [rows, columns] }, cells) {
  const canvas = new OffscreenCanvas(columns, rows), context = canvas.getContext("2d");
  const pixels = context.createImageData(columns, rows);
  cells.forEach((cell, index) => {
    pixels.data.set(cell < 0 ? LOWERS : RAISES, 4 * index);
    pixels.data[4 * index + 3] = 2 * Math.abs(cell);
  });
  context.putImageData(pixels, 0, 0);
  return canvas;
}

function schedule() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    draw();
    owed.splice(0).forEach(send);
  });
}

function draw() {
  if (hasNewPicture) drawPicture();
  hasNewPicture = false;
  if (!update) return;
  tellMargin();
  const now = performance.now();
  if (now - toldAt < TOLD_MS) return;
  toldAt = now;
  settings.network ? drawMargins() : drawShear();
  tellControls();
  tellHealth();
  tellFacts();
}

function drawPicture() {
  if (!image) return;
  const canvas = $.picture, { width, height, arrows } = facts;
  document.documentElement.style.setProperty("--aspect", width / height);
  const scale = fit(canvas) * (canvas.clientWidth / width);
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.globalCompositeOperation = "source-over";
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  if (map && !mapFacts.alike) {
    // dimmed grey, so that every colour that is seen is relevance
    for (const [way, colour] of [["saturation", "#808080"], ["multiply", "#8c8c8c"]]) {
      context.globalCompositeOperation = way;
      context.fillStyle = colour;
      context.fillRect(0, 0, canvas.width, canvas.height);
    }
    context.globalCompositeOperation = "source-over";
    context.drawImage(map, 0, 0, canvas.width, canvas.height);
  }
  context.setTransform(scale, 0, 0, scale, 0, 0);
  if ($.arrows.checked) drawArrows(context, arrows, devicePixelRatio / scale);
}

function drawArrows(context, arrows, px) {
  // white on dark, so that they are seen on any picture
  for (const [colour, width] of [["#000c", 3.5], ["#fff", 1.5]]) {
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = width * px;
    context.lineCap = "round";
    context.beginPath();
    for (const [x, y, toX, toY] of arrows) {
      const length = Math.hypot(toX - x, toY - y);
      const head = Math.min(5 * px, length / 2), way = Math.atan2(toY - y, toX - x);
      context.moveTo(x, y);
      context.lineTo(toX, toY); // one that stands still is a dot
      for (const turn of length < 0.5 ? [] : [-2.6, 2.6]) {
        context.moveTo(toX, toY);
        context.lineTo(toX + head * Math.cos(way + turn), toY + head * Math.sin(way + turn));
      }
    }
    context.stroke();
  }
}

function drawMargins() {
  drawChart($.chart, {
    most: 1,
    ticks: [0, ...settings.target, 1],
    words: (margin) => `${Math.round(100 * margin)} %`,
    zone: settings.target,
    band: ["low", "high"],
    lines: [["true_margin", "--faint", 1.5, [4, 4]], ["margin", "--ink", 2, []]],
    note: `safety margin and its interval${points.some((point) => point.true_margin !== null) ? "; dashed: true" : ""}`,
  });
}

function drawShear() {
  const most = Math.max(2, Math.ceil(Math.max(...points.map(({ shear_px }) => shear_px ?? 0))));
  drawChart($.chart, {
    most,
    ticks: [0, most / 2, most],
    words: (shear) => `${shear} px`,
    lines: [["shear_px", "--ink", 2, []]],
    note: "shear of the markers",
  });
}

function drawForces() {
  const most = Math.ceil(Math.max(2, ...points.map(({ force_n, least_force_n }) => Math.max(force_n, least_force_n))));
  drawChart($.force, {
    most,
    ticks: Array.from({ length: most + 1 }, (_, tick) => tick),
    words: (force) => `${force} N`,
    band: ["least_force_n", "force_n"],
    lines: [["least_force_n", "--faint", 1.5, [4, 4]], ["force_n", "--ink", 2, []]],
    note: "grip force; dashed: the least that holds",
  });
}

function drawChart(canvas, { most, ticks, words, zone, band, lines, note }) {
  const dpr = fit(canvas), style = getComputedStyle(document.body);
  // a canvas takes no light-dark(): the colour as it is shown
  const colour = (name) => ((document.body.style.outlineColor = `var(${name})`), style.outlineColor);
  const context = canvas.getContext("2d");
  context.setTransform(dpr, 0, 0, dpr, 0, 0);
  const left = 42, top = 20, right = canvas.clientWidth - 6, bottom = canvas.clientHeight - 20;
  context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  const x = (at) => right - ((update.now_s - at) / settings.chart_s) * (right - left);
  const y = (value) => bottom - (value / most) * (bottom - top);
  if (zone) {
    context.fillStyle = colour("--zone");
    context.fillRect(left, y(zone[1]), right - left, y(zone[0]) - y(zone[1]));
  }
  context.font = "12px system-ui, sans-serif";
  context.lineWidth = 1;
  context.strokeStyle = colour("--line");
  context.fillStyle = colour("--faint");
  context.textBaseline = "middle";
  context.textAlign = "right";
  for (const tick of ticks) {
    context.beginPath();
    context.moveTo(left, y(tick));
    context.lineTo(right, y(tick));
    context.stroke();
    context.fillText(words(tick), left - 4, y(tick));
  }
  context.textBaseline = "top";
  context.fillText(note, right, 3);
  for (const [share, align] of [[1, "left"], [2 / 3, "center"], [1 / 3, "center"], [0, "right"]]) {
    const ago = share * settings.chart_s;
    context.textAlign = align;
    context.fillText(ago ? `${Math.round(ago)} s ago` : "now", x(update.now_s - ago), bottom + 5);
  }
  context.save();
  context.beginPath();
  context.rect(left, 0, right - left, bottom + 2);
  context.clip();
  for (const run of band ? runs(band[0]) : []) {
    context.beginPath();
    run.forEach((point) => context.lineTo(x(point.at_s), y(point[band[1]])));
    run.reverse().forEach((point) => context.lineTo(x(point.at_s), y(point[band[0]])));
    context.fillStyle = colour("--interval");
    context.fill();
  }
  for (const [name, paint, width, dashes] of lines) {
    context.strokeStyle = colour(paint);
    context.lineWidth = width;
    context.lineJoin = "round";
    context.setLineDash(dashes);
    for (const run of runs(name)) {
      context.beginPath();
      run.forEach((point) => context.lineTo(x(point.at_s), y(point[name])));
      context.stroke();
    }
  }
  context.restore();
}

function tellMargin() {
  const { reading, words, ended } = update;
  if (!reading) return withdraw(ended ?? "waiting for the first frame");
  if (!settings.network && !reading.withheld) {
    tellMarkers(reading, words);
  } else if (!words.margin) {
    withdraw(words.advice, words.zone);
  } else {
    set($.number, words.margin);
    set($.words, `${SIGNS[words.zone]} ${words.advice}`);
    set($.band, words.interval && `true margin with 90 % confidence: ${words.interval}`);
    document.body.dataset.zone = words.zone;
    place(".pointer", reading.margin);
    place(".interval", reading.low ?? 0, words.interval ? reading.high : reading.low ?? 0);
  }
  say();
  set($.caption, describePicture());
  $.legend.hidden = !mapFacts || mapFacts.alike;
  if (mapFacts) set($.full, `full colour: ${(100 * mapFacts.full).toPrecision(2)} points a pixel`);
}

function tellMarkers({ slip, markers }, { advice }) {
  const touches = markers?.contact, sticks = markers?.stick_share;
  set($.number, slip ? (touches === false ? "no contact" : slip) : "no markers");
  const parts = touches ? [`sheared by ${amount(markers.shear_px, "px")}`] : [];
  if (touches && sticks !== null) parts.push(`${Math.round(100 * sticks)} % of the markers stick to the middle`);
  set($.words, parts.join(", "));
  set($.band, advice);
  document.body.dataset.zone = slip === "slip" ? "below" : "none";
}

function describePicture() {
  const { frozen, waiting } = update, parts = [];
  if (frozen) parts.push(`❄ frozen: ${frozen}`);
  if (mapFacts) {
    const { alike, baseline, baseline_prediction, method, number, warnings } = mapFacts;
    // "stick": the last frame before the pull; "untouched": the reference
    const compared = baseline === null ? "as untouched" : `as before the pull (stick, frame ${baseline})`;
    // the margin itself stands above, and of a frozen picture before this: not a second time, of another frame
    if (alike) parts.push(`nothing to explain: ${compared}`);
    else {
      const title = settings.methods[method] ?? method;
      parts.push(`why not ${Math.round(100 * baseline_prediction)} %, ${compared}: ${title} of frame ${number}`);
      if (frozen) parts.push(...warnings.map((warning) => `▲ ${warning}`));
      else parts.push(`for speed, not the recommended map: Explain (E) shows ${settings.methods[settings.recommended]}`);
    }
  }
  if (waiting) parts.push(`${waiting} …`);
  return parts.join(" · ");
}

function withdraw(why, zone = "none") {
  set($.number, "–");
  set($.words, `${SIGNS[zone]} ${why}`.trim());
  set($.band, "");
  document.body.dataset.zone = zone;
  place(".pointer", -1);
  place(".interval", 0, 0);
  say();
}

function say() {
  // for those who listen: what changed, and not thirty times a second
  const words = $.words.textContent;
  if (words === $.heard.dataset.words || performance.now() - saidAt < 2000) return;
  saidAt = performance.now();
  $.heard.dataset.words = words;
  $.heard.textContent = `${$.number.textContent} ${words}`;
}

function tellControls() {
  const controls = update.controls;
  $.fingertip.hidden = controls?.kind !== "fingertip";
  $.gripper.hidden = $.grip.hidden = controls?.kind !== "gripper";
  document.querySelector("[data-act=freeze]").textContent = update.frozen ? "Go on (F)" : "Freeze (F)";
  document.querySelector("[data-act=record]").textContent = update.recording ? "Stop recording (C)" : "Record (C)";
  if (!controls) return;
  const { press_n, pull_n, wanted_n, water_kg } = controls;
  const held = wanted_n > pull_n + 0.005 ? ", slips" : ""; // friction holds no more than that
  const words = {
    press_n: `Press ${press_n?.toFixed(2)} N`,
    pull_n: `Pull ${pull_n?.toFixed(2)} N${held}`,
    water_kg: `Water ${Math.round(1e3 * water_kg)} g`,
  };
  for (const slider of sliders.filter((slider) => !slider.closest("[hidden]"))) {
    set(slider.previousElementSibling, words[slider.name]);
    if (performance.now() - (slider.movedAt ?? -HAND_MS) >= HAND_MS) slider.value = controls[slider.name];
  }
  if (controls.kind !== "gripper") return;
  $.wet.checked = controls.wet;
  if (document.activeElement !== $.controller) $.controller.value = controls.chosen;
  drawForces();
  const state = controls.phase === "dropped" || controls.phase === "crushed" ? "bad" : "";
  $.status.dataset.state = state;
  const slid = controls.slip_m > 5e-5 ? `, slid ${(1e3 * controls.slip_m).toFixed(1)} mm` : "";
  const force = `${controls.force_n.toFixed(2)} N, ${controls.least_force_n.toFixed(2)} N would hold`;
  set($.status, `${state ? "▲" : "●"} ${controls.phase}: ${force}${slid}. ${controls.controller}: ${controls.why || "waits"}`);
}

function tellHealth() {
  const { reading } = update, told = [];
  if (reading?.slip) {
    const state = { slip: "bad", "no full slip": "good" }[reading.slip] ?? "unknown";
    told.push({ name: "slip", state, value: reading.slip, sentence: `the markers tell: ${reading.slip}` });
  }
  for (const { name, value, limit, ok, sentence } of reading?.health ?? []) {
    const unit = settings.units[name] ?? "";
    const bound = limit === null ? "" : `; limit ${amount(limit, unit)}`;
    told.push({ name, state: ok ? "good" : "bad", value: amount(value, unit), sentence: `${sentence}${bound}` });
  }
  const names = new Set(told.map(({ name }) => name));
  for (const [name, lamp] of lamps) if (!names.has(name)) lamp.remove(), lamps.delete(name);
  if (!told.length) return set($.lamps, "health is not watched here");
  if (!lamps.size) $.lamps.replaceChildren();
  for (const { name, state, value, sentence } of told) {
    let lamp = lamps.get(name);
    if (!lamp) {
      lamp = document.createElement("details");
      lamp.append(document.createElement("summary"), document.createElement("p"));
      lamps.set(name, lamp);
      $.lamps.append(lamp);
    }
    if (lamp.dataset.state !== state) {
      lamp.dataset.state = state;
      lamp.open = state === "bad"; // its cure is seen without asking
    }
    set(lamp.firstChild, `${{ good: "✓", bad: "▲", unknown: "?" }[state]} ${name}: ${value}`);
    set(lamp.lastChild, sentence);
  }
}

function tellFacts() {
  const { reading, words, rate_hz, recording, ended, troubles } = update;
  const ms = (value) => (value === null || value === undefined ? "–" : `${Math.round(value)} ms`);
  const latency = reading?.latency ?? {};
  const parts = ["decode", "checks", "encode", "network"].map((part) => `${part} ${ms(latency[`${part}_ms`])}`);
  const rows = {
    readings: ended ? "ended" : `${rate_hz.toFixed(1)} a second, ${reading?.dropped ?? 0} frames dropped`,
    latency: `${ms(latency.total_ms)} to the reading (${parts.join(", ")})`,
    contact: words?.contact ?? "unknown",
    friction: reading?.friction ? `taken for ${reading.friction}` : "",
  };
  const shown = Object.entries(rows).filter(([, value]) => value).flat();
  while ($.facts.children.length > shown.length) $.facts.lastChild.remove();
  while ($.facts.children.length < shown.length) {
    $.facts.append(document.createElement("dt"), document.createElement("dd"));
  }
  shown.forEach((text, index) => set($.facts.children[index], text));
  $.recording.hidden = !recording;
  set($.recording, `● recording ${recording}`);
  set($.troubles, troubles.map((trouble) => `▲ ${trouble}`).join("\n"));
}

function notify(text) {
  const notice = document.createElement("p");
  notice.textContent = text;
  $.notices.append(notice);
  setTimeout(() => notice.remove(), NOTICE_MS);
}

function lookForSilence() {
  const quiet = performance.now() - heardAt;
  if (document.hidden || update?.ended || quiet < QUIET_MS || socket.readyState !== WebSocket.OPEN) return;
  withdraw(`no word from sliplens for ${Math.round(quiet / 1000)} s`);
}

function act(name) {
  send({ act: name, ...(name === "explain" && { method: $.method.value }) });
}

// Send the forces of a person's hand, a few times a second, and at its end.
function move(slider) {
  slider.movedAt = performance.now();
  clearTimeout(slider.later);
  const sends = () => {
    slider.sentAt = performance.now();
    const own = slider.closest("section");
    const values = [...own.querySelectorAll("[type=range]")].map(({ name, value }) => [name, Number(value)]);
    send({ act: own.id === "fingertip" ? "load" : "pour", ...Object.fromEntries(values) });
  };
  if (slider.movedAt - (slider.sentAt ?? 0) > 50) sends();
  else slider.later = setTimeout(sends, 50);
}

function amount(value, unit) {
  if (value === null || value === undefined) return "–";
  const short = (number) => (Math.abs(number) < 0.005 ? "0" : Number(number.toPrecision(2)).toString());
  return unit === "share" ? `${short(100 * value)} %` : `${short(value)} ${unit === "ratio" ? "times" : unit}`;
}

function place(part, from, to = null) {
  const { style } = $.gauge.querySelector(part);
  style.left = `${100 * from}%`;
  if (to !== null) style.width = `${100 * (to - from)}%`;
  style.display = from < 0 ? "none" : "";
}

function set(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Give a canvas as many pixels as the screen shows of it; the ratio of both.
function fit(canvas) {
  const dpr = devicePixelRatio;
  const width = Math.round(canvas.clientWidth * dpr), height = Math.round(canvas.clientHeight * dpr);
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  return dpr;
}

// Points in a row that have a value, with no long pause between them.
function runs(name) {
  const rows = [];
  let last = null;
  for (const point of points) {
    if (point[name] !== null && (last === null || point.at_s - last.at_s > 1)) rows.push([]);
    last = point[name] === null ? null : point;
    if (last) rows.at(-1).push(point);
  }
  return rows;
}

function redraw() {
  hasNewPicture = true;
  toldAt = -TOLD_MS;
  schedule();
}

document.addEventListener("click", ({ target }) => target.dataset.act && act(target.dataset.act));
document.addEventListener("keydown", ({ key, target, repeat, ctrlKey, altKey, metaKey }) => {
  const name = KEYS[key.toLowerCase()];
  if (name && !repeat && !ctrlKey && !altKey && !metaKey && !target.matches("select")) act(name);
});
document.addEventListener("input", ({ target }) => target.type === "range" && move(target));
$.map.onchange = show;
$.arrows.onchange = redraw;
$.wet.onchange = $.controller.onchange = () => send({ act: "hold", wet: $.wet.checked, controller: $.controller.value });
const sizes = new ResizeObserver(redraw);
[$.picture, $.chart].forEach((canvas) => sizes.observe(canvas));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
setInterval(lookForSilence, 500);
connect();
