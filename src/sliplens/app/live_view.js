// Number, picture, chart and lamps of a running sensor, drawn from messages of a binary websocket.
//
// A message is the length of its header in 4 bytes (little end first), the header as JSON, a JPEG and the cells of a
// map where they are new (sliplens/app/feed.py: Update). What was drawn is answered by its serial number; who does not
// answer is sent no more than two messages, so that nobody waits for a slow or hidden window.

const QUIET_MS = 3000; // without a message, after which nothing shown can be believed
const RETRY_MS = 1000;
const TOLD_MS = 200; // between two drawings of chart, lamps and facts: numbers that change faster nobody reads
// Zones of sliplens/live/reading.py, each with a sign beside its colour.
const SIGNS = { none: "", below: "▼", uncertain: "?", within: "●", "not below": "●", above: "▲" };

export default {
  template: `
    <div class="sl-view">
      <section class="sl-margin" aria-label="safety margin">
        <div class="sl-number" ref="number">–</div>
        <div class="sl-told">
          <div class="sl-words" ref="words">connecting</div>
          <div class="sl-band" ref="band"></div>
        </div>
        <svg class="sl-gauge" viewBox="0 0 100 12" preserveAspectRatio="none" aria-hidden="true">
          <rect class="sl-track" x="0" y="3" width="100" height="6" />
          <rect class="sl-zone" :x="100 * target[0]" y="0" :width="100 * (target[1] - target[0])" height="12" />
          <rect class="sl-interval" ref="interval" y="4.5" height="3" />
          <rect class="sl-pointer" ref="pointer" y="0" width="1" height="12" />
        </svg>
        <div class="sl-scale" aria-hidden="true">
          <span style="left: 0">0 % slips</span>
          <span :style="{ left: 50 * (target[0] + target[1]) + '%' }">target</span>
          <span style="left: 100%">100 % sticks</span>
        </div>
        <div class="sl-only-heard" role="status" aria-live="polite" ref="heard"></div>
      </section>
      <section class="sl-seen" aria-label="picture">
        <canvas class="sl-picture" ref="picture" role="img" aria-label="frame of the camera in the fingertip"></canvas>
        <div class="sl-caption" ref="caption"></div>
        <div class="sl-legend" ref="legend" hidden>
          <span><i :style="{ background: lowers }"></i>lowers the margin</span>
          <span><i :style="{ background: raises }"></i>raises it</span>
          <span ref="full"></span>
        </div>
      </section>
      <section class="sl-controls" aria-label="controls"><slot></slot></section>
      <section class="sl-told-of" aria-label="the last seconds and health">
        <canvas class="sl-chart" ref="chart" role="img" aria-label="safety margin over the last seconds"></canvas>
        <div v-show="grips">
          <canvas class="sl-chart" ref="force" role="img" aria-label="grip force over the last seconds"></canvas>
          <div class="sl-grip" role="status" ref="grip"></div>
        </div>
        <div class="sl-recording" ref="recording" hidden></div>
        <div class="sl-recording" ref="troubles" role="alert"></div>
        <div class="sl-lamps" ref="lamps"></div>
        <dl class="sl-facts" ref="facts"></dl>
      </section>
    </div>`,
  props: {
    path: String,
    chartS: Number,
    target: Array,
    lowers: String,
    raises: String,
    methods: Object,
    recommended: String,
    grips: Boolean,
  },
  mounted() {
    // nothing of this is reactive: it changes with each frame, and is drawn by hand
    this.points = [];
    this.update = null;
    this.owed = [];
    this.image = this.facts = this.map = this.mapFacts = null;
    this.heardAt = performance.now();
    this.saidAt = 0;
    this.lamps = new Map();
    this.gone = false;
    this.connect();
    this.watch = setInterval(() => this.lookForSilence(), 500);
    this.toldAt = -TOLD_MS;
    this.redraw = () => {
      this.hasNewPicture = true;
      this.toldAt = -TOLD_MS;
      this.schedule();
    };
    this.sizes = new ResizeObserver(this.redraw);
    this.sizes.observe(this.$el);
    this.theme = new MutationObserver(this.redraw);
    this.theme.observe(document.body, { attributeFilter: ["class"] });
    this.onHide = () => document.hidden && this.owed.forEach((owed) => (owed.drawn = false));
    document.addEventListener("visibilitychange", this.onHide);
  },
  unmounted() {
    this.gone = true;
    clearInterval(this.watch);
    this.sizes.disconnect();
    this.theme.disconnect();
    document.removeEventListener("visibilitychange", this.onHide);
    this.socket?.close();
  },
  methods: {
    connect() {
      const scheme = location.protocol === "https:" ? "wss:" : "ws:";
      this.socket = new WebSocket(`${scheme}//${location.host}${this.path}`);
      this.socket.binaryType = "arraybuffer";
      let turn = Promise.resolve(); // pictures are decoded one after another
      // one that cannot be read is passed over: those after it are still taken
      this.socket.onmessage = ({ data }) => (turn = turn.then(() => this.take(data)).catch(console.error));
      this.socket.onclose = () => {
        this.owed = [];
        if (this.gone) return;
        this.withdraw("no connection to sliplens: it has stopped, or the network is down");
        setTimeout(() => this.gone || this.connect(), RETRY_MS);
      };
    },
    async take(data) {
      const length = new DataView(data).getUint32(0, true);
      const update = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      const hadMap = this.map !== null;
      let at = 4 + length;
      if (update.picture) {
        const jpeg = new Blob([new Uint8Array(data, at, update.picture_bytes)], { type: "image/jpeg" });
        const before = this.image;
        this.image = await createImageBitmap(jpeg);
        this.facts = update.picture;
        before?.close();
        at += update.picture_bytes;
      }
      if (update.map) {
        this.map = this.paintMap(update.map, new Int8Array(data, at, update.map_bytes));
        this.mapFacts = update.map;
      } else if (!update.has_map) {
        this.map = this.mapFacts = null;
      }
      this.hasNewPicture ||= Boolean(update.picture || update.map) || hadMap !== (this.map !== null);
      this.points.push(...update.points);
      while (this.points.length && this.points[0].at_s < update.now_s - this.chartS) this.points.shift();
      this.update = update;
      this.heardAt = performance.now();
      this.owed.forEach((owed) => (owed.drawn = false)); // passed over by this one
      this.owed.push({ serial: update.serial, drawn: !document.hidden });
      this.schedule();
    },
    paintMap({ rows, columns }, cells) {
      const canvas = new OffscreenCanvas(columns, rows);
      const context = canvas.getContext("2d");
      const image = context.createImageData(columns, rows);
      const below = rgb(this.lowers), above = rgb(this.raises);
      cells.forEach((cell, index) => {
        image.data.set(cell < 0 ? below : above, 4 * index);
        image.data[4 * index + 3] = 2 * Math.abs(cell);
      });
      context.putImageData(image, 0, 0);
      return canvas;
    },
    schedule() {
      if (this.scheduled) return;
      this.scheduled = true;
      requestAnimationFrame(() => {
        this.scheduled = false;
        if (this.gone) return;
        this.draw();
        for (const owed of this.owed.splice(0)) {
          if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(owed));
        }
      });
    },
    draw() {
      if (this.hasNewPicture) this.drawPicture();
      this.hasNewPicture = false;
      if (this.update) this.tellMargin();
      const now = performance.now();
      if (now - this.toldAt < TOLD_MS) return;
      this.toldAt = now;
      this.drawMargins();
      if (this.grips) this.drawForces();
      if (!this.update) return;
      this.tellHealth();
      this.tellFacts();
    },
    drawPicture() {
      const canvas = this.$refs.picture;
      if (!this.image) return;
      const { width, height, arrows } = this.facts;
      const scale = fit(canvas, this.image.width / this.image.height) * (canvas.clientWidth / width);
      const context = canvas.getContext("2d");
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.globalCompositeOperation = "source-over";
      context.drawImage(this.image, 0, 0, canvas.width, canvas.height);
      if (this.map && !this.mapFacts.alike) {
        // dimmed grey, so that every colour that is seen is relevance
        for (const [way, colour] of [["saturation", "#808080"], ["multiply", "#8c8c8c"]]) {
          context.globalCompositeOperation = way;
          context.fillStyle = colour;
          context.fillRect(0, 0, canvas.width, canvas.height);
        }
        context.globalCompositeOperation = "source-over";
        context.drawImage(this.map, 0, 0, canvas.width, canvas.height);
      }
      context.setTransform(scale, 0, 0, scale, 0, 0);
      if (arrows.length && this.mapFacts) this.drawMarkers(context, 1 / scale);
      this.drawArrows(context, arrows, devicePixelRatio / scale);
    },
    drawMarkers(context, px) {
      const most = Math.max(1e-6, ...this.mapFacts.markers.map(([, , relevance]) => Math.abs(relevance)));
      for (const [x, y, relevance] of this.mapFacts.markers) {
        const share = Math.sqrt(Math.abs(relevance) / most);
        context.beginPath();
        context.arc(x, y, 7 * devicePixelRatio * px * share, 0, 2 * Math.PI);
        context.strokeStyle = relevance < 0 ? this.lowers : this.raises;
        context.lineWidth = 2 * devicePixelRatio * px;
        context.stroke();
      }
    },
    drawArrows(context, arrows, px) {
      // white on dark, so that they are seen on any picture
      for (const [colour, width] of [["#000c", 3.5], ["#fff", 1.5]]) {
        context.strokeStyle = colour;
        context.lineWidth = width * px;
        context.lineCap = "round";
        context.beginPath();
        for (const [x, y, toX, toY] of arrows) {
          const length = Math.hypot(toX - x, toY - y);
          if (length < 0.5) continue;
          const head = Math.min(5 * px, length / 2), way = Math.atan2(toY - y, toX - x);
          context.moveTo(x, y);
          context.lineTo(toX, toY);
          for (const turn of [-2.6, 2.6]) {
            context.moveTo(toX, toY);
            context.lineTo(toX + head * Math.cos(way + turn), toY + head * Math.sin(way + turn));
          }
        }
        context.stroke();
      }
    },
    drawMargins() {
      this.drawChart(this.$refs.chart, {
        most: 1,
        ticks: [0, ...this.target, 1],
        words: (margin) => `${Math.round(100 * margin)} %`,
        zone: this.target,
        band: ["low", "high"],
        lines: [["true_margin", "--sl-faint", 1.5, [4, 4]], ["margin", "--sl-ink", 2, []]],
        note: this.points.some((point) => point.true_margin !== null) ? "dashed: the true margin" : "",
      });
    },
    drawForces() {
      const most = Math.ceil(Math.max(2, ...this.points.map(({ force_n, least_force_n }) => Math.max(force_n, least_force_n))));
      this.drawChart(this.$refs.force, {
        most,
        ticks: Array.from({ length: most + 1 }, (_, tick) => tick),
        words: (force) => `${force} N`,
        zone: null,
        band: ["least_force_n", "force_n"],
        lines: [["least_force_n", "--sl-faint", 1.5, [4, 4]], ["force_n", "--sl-ink", 2, []]],
        note: "grip force; dashed: the least that holds",
      });
      const { grip } = this.update ?? {};
      if (!grip) return;
      const state = grip.phase === "dropped" || grip.phase === "crushed" ? "bad" : "";
      this.$refs.grip.dataset.state = state;
      const slid = grip.slip_m > 5e-5 ? `, slid ${(1e3 * grip.slip_m).toFixed(1)} mm` : "";
      const force = `${grip.force_n.toFixed(2)} N, ${grip.least_force_n.toFixed(2)} N would hold`;
      set(this.$refs.grip, `${state ? "▲" : "●"} ${grip.phase}: ${force}${slid}. ${grip.controller}: ${grip.why || "waits"}`);
    },
    drawChart(canvas, { most, ticks, words, zone, band: [below, above], lines, note }) {
      const dpr = fit(canvas, null), style = getComputedStyle(canvas);
      const colour = (name) => style.getPropertyValue(name);
      const context = canvas.getContext("2d");
      context.setTransform(dpr, 0, 0, dpr, 0, 0);
      const left = 38, top = 20, right = canvas.clientWidth - 6, bottom = canvas.clientHeight - 20;
      context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
      const now = this.update?.now_s ?? 0;
      const x = (at) => right - ((now - at) / this.chartS) * (right - left);
      const y = (value) => bottom - (value / most) * (bottom - top);
      if (zone) {
        context.fillStyle = colour("--sl-zone");
        context.fillRect(left, y(zone[1]), right - left, y(zone[0]) - y(zone[1]));
      }
      context.font = "11px system-ui, sans-serif";
      context.lineWidth = 1;
      context.strokeStyle = colour("--sl-line");
      context.fillStyle = colour("--sl-faint");
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
      for (const ago of [this.chartS, (2 / 3) * this.chartS, this.chartS / 3, 0]) {
        context.textAlign = ago === 0 ? "right" : ago === this.chartS ? "left" : "center";
        context.fillText(ago ? `${Math.round(ago)} s ago` : "now", x(now - ago), bottom + 5);
      }
      context.save();
      context.beginPath();
      context.rect(left, 0, right - left, bottom + 2);
      context.clip();
      for (const run of runs(this.points, below)) {
        context.beginPath();
        run.forEach((point) => context.lineTo(x(point.at_s), y(point[above])));
        run.reverse().forEach((point) => context.lineTo(x(point.at_s), y(point[below])));
        context.fillStyle = colour("--sl-interval");
        context.fill();
      }
      for (const [name, paint, width, dashes] of lines) {
        context.strokeStyle = colour(paint);
        context.lineWidth = width;
        context.lineJoin = "round";
        context.setLineDash(dashes);
        for (const run of runs(this.points, name)) {
          context.beginPath();
          run.forEach((point) => context.lineTo(x(point.at_s), y(point[name])));
          context.stroke();
        }
      }
      context.restore();
      context.setLineDash([]);
      context.fillStyle = colour("--sl-faint");
      context.textAlign = "right";
      context.fillText(note, right, 4);
    },
    tellMargin() {
      const { reading, words: said, ended, waiting } = this.update;
      const { number, words, band, pointer, interval } = this.$refs;
      if (!reading) return this.withdraw(ended ?? "waiting for the first frame");
      if (!said.margin) {
        this.withdraw(said.advice, said.zone);
      } else {
        number.textContent = said.margin;
        this.$el.dataset.zone = said.zone;
        words.textContent = `${SIGNS[said.zone]} ${said.advice}`;
        pointer.setAttribute("x", Math.max(0, Math.min(99, 100 * reading.margin - 0.5)));
        pointer.style.display = "";
        const calibrated = Boolean(said.interval);
        interval.setAttribute("x", calibrated ? 100 * reading.low : 0);
        interval.setAttribute("width", calibrated ? 100 * (reading.high - reading.low) : 0);
        band.textContent = calibrated ? `true margin with 90 % confidence: ${said.interval}` : "";
      }
      this.say();
      this.$refs.caption.textContent = this.describePicture(waiting);
      const map = this.mapFacts;
      this.$refs.legend.hidden = !map || map.alike;
      if (map) this.$refs.full.textContent = `full colour: ${(100 * map.full).toPrecision(2)} points a pixel`;
    },
    describePicture(waiting) {
      const { frozen } = this.update, map = this.mapFacts;
      const parts = [];
      if (frozen) parts.push(`❄ frozen: ${frozen}`);
      if (map) {
        // the margin itself stands above, and of a frozen picture before this: not a second time, of another frame
        if (map.alike) parts.push("nothing to explain: as untouched");
        else parts.push(
          `why not ${Math.round(100 * map.reference_prediction)} %, as untouched: ` +
            `${this.methods[map.method] ?? map.method} of frame ${map.number}`,
          ...(frozen
            ? map.warnings.map((warning) => `▲ ${warning}`)
            : [`for speed, not the recommended map: Explain (E) shows ${this.methods[this.recommended]}`]),
        );
      }
      if (waiting) parts.push(`⏳ ${waiting}`);
      return parts.join(" · ");
    },
    withdraw(why, zone = "none") {
      const { number, words, band, pointer, interval } = this.$refs;
      if (!number) return;
      number.textContent = "–";
      words.textContent = `${SIGNS[zone]} ${why}`.trim();
      band.textContent = "";
      this.$el.dataset.zone = zone;
      pointer.style.display = "none";
      interval.setAttribute("width", 0);
      this.say();
    },
    say() {
      // for those who listen: what changed, and not thirty times a second
      const words = this.$refs.words.textContent;
      if (words === this.$refs.heard.dataset.words || performance.now() - this.saidAt < 2000) return;
      this.saidAt = performance.now();
      this.$refs.heard.dataset.words = words;
      this.$refs.heard.textContent = `${this.$refs.number.textContent} ${words}`;
    },
    tellHealth() {
      const { reading } = this.update;
      const lamps = [];
      if (reading?.slip) {
        const state = { slip: "bad", "no full slip": "good" }[reading.slip] ?? "unknown";
        lamps.push({ name: "slip", state, value: reading.slip, sentence: `the markers tell: ${reading.slip}` });
      }
      for (const { name, value, limit, ok, sentence } of reading?.health ?? []) {
        const told = value === null ? "–" : Number(value.toPrecision(2)).toString();
        const bound = limit === null ? "" : `; limit ${Number(limit.toPrecision(2))}`;
        lamps.push({ name, state: ok ? "good" : "bad", value: told, sentence: `${sentence}${bound}` });
      }
      const box = this.$refs.lamps;
      const names = new Set(lamps.map(({ name }) => name));
      for (const [name, element] of this.lamps) if (!names.has(name)) element.remove(), this.lamps.delete(name);
      for (const { name, state, value, sentence } of lamps) {
        let lamp = this.lamps.get(name);
        if (!lamp) {
          lamp = document.createElement("details");
          lamp.append(document.createElement("summary"), document.createElement("p"));
          this.lamps.set(name, lamp);
          box.append(lamp);
        }
        if (lamp.dataset.state !== state) {
          lamp.dataset.state = state;
          lamp.open = state === "bad"; // its cure is seen without asking
        }
        set(lamp.firstChild, `${{ good: "✓", bad: "▲", unknown: "?" }[state]} ${name}: ${value}`);
        set(lamp.lastChild, sentence);
      }
      if (!lamps.length) set(box, "health is not watched here");
      else if (box.firstChild.nodeType === Node.TEXT_NODE) box.firstChild.remove();
    },
    tellFacts() {
      const { reading, words, rate_hz, drawn_ms, viewers, recording, ended, sinks, troubles } = this.update;
      const ms = (value) => (value === null || value === undefined ? "–" : `${Math.round(value)} ms`);
      const latency = reading?.latency ?? {};
      const rows = {
        readings: ended ? "ended" : `${rate_hz.toFixed(1)} a second`,
        latency: `${ms(latency.total_ms)} to the reading`,
        "of that": ["decode", "checks", "encode", "network"].map((part) => `${part} ${ms(latency[`${part}_ms`])}`).join(", "),
        drawn: `${ms(drawn_ms)} after the capture`,
        ...(reading?.friction ? { friction: `taken for ${reading.friction}` } : {}),
        ...(reading?.sequence ? { "read in order": "earlier frames of the contact count" } : {}),
        dropped: `${reading?.dropped ?? 0} frames`,
        contact: words?.contact ?? "unknown",
        viewers: `${viewers}`,
        ...(sinks.length ? { sent: sinks.map(({ name, sent, lost }) => `${name} ${sent}, ${lost} lost`).join("; ") } : {}),
      };
      const list = this.$refs.facts;
      // rows more where friction is told or frames are read in order, which a withheld reading does not say
      if (list.dataset.names !== `${Object.keys(rows)}`) {
        list.dataset.names = `${Object.keys(rows)}`;
        list.replaceChildren(
          ...Object.keys(rows).flatMap((name) => {
            const term = document.createElement("dt");
            term.textContent = name;
            return [term, document.createElement("dd")];
          }),
        );
      }
      Object.values(rows).forEach((value, index) => set(list.children[2 * index + 1], value));
      const line = this.$refs.recording;
      line.hidden = !recording;
      if (recording) {
        const lost = recording.lost ? `, ${recording.lost} lost` : "";
        const told = `● recording ${recording.seconds.toFixed(1)} s, ${recording.sent} frames${lost}: ${recording.name}`;
        set(line, told);
      }
      set(this.$refs.troubles, troubles.map((trouble) => `▲ ${trouble}`).join("\n"));
    },
    lookForSilence() {
      if (document.hidden || this.update?.ended) return;
      const quiet = performance.now() - this.heardAt;
      if (quiet > QUIET_MS && this.socket.readyState === WebSocket.OPEN) {
        this.withdraw(`no word from sliplens for ${Math.round(quiet / 1000)} s`);
      }
    },
  },
};

function set(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function rgb(colour) {
  return [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
}

// Give a canvas as many pixels as the screen shows of it; the ratio of both.
function fit(canvas, aspect) {
  const dpr = devicePixelRatio;
  if (aspect && canvas.style.aspectRatio !== `${aspect}`) canvas.style.aspectRatio = `${aspect}`;
  const width = Math.round(canvas.clientWidth * dpr), height = Math.round(canvas.clientHeight * dpr);
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  return dpr;
}

// Points in a row that have a value, with no long pause between them.
function runs(points, name) {
  const found = [];
  let last = null;
  for (const point of points) {
    if (point[name] === null) {
      last = null;
      continue;
    }
    if (last === null || point.at_s - last.at_s > 1) found.push([]);
    found.at(-1).push(point);
    last = point;
  }
  return found;
}
