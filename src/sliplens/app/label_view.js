// A trial whose labels are repaired by hand: its frame, its forces and its margin under one cursor.
//
// What is shown comes as one record (sliplens/app/labels.py: TrialView); what is wished goes back as an edit, and the
// trial comes anew. Moving through frames asks nobody but the pictures.

const KEYS = {
  r: "reference", c: "contact", s: "slip", b: "bad", g: "good", t: "tare", m: "sign", u: "undo", "[": "from", "]": "to",
};
const HEAD = 14; // of the curves, where the words of events stand
const AXES = ["--sl-x", "--sl-y", "--sl-z"];
const WORDS = {
  reference_frame: "reference", contact_s: "contact", slip_s: "slip", tare: "tare", normal_sign: "sign", mu: "friction",
  bad: "bad", good: "good again",
};

export default {
  template: `
    <div class="sl-labels">
      <header class="sl-bar">
        <label>trial
          <select :value="view?.trial" @change="open($event.target.value)" aria-label="trial">
            <option v-for="(count, name) in counts" :key="name" :value="name">
              {{ name }}{{ count ? " (" + count + (count > 1 ? " edits)" : " edit)") : "" }}
            </option>
          </select>
        </label>
        <button @click="turn(-1)" title="trial before (Page up)" aria-label="trial before">◀</button>
        <button @click="turn(1)" title="next trial (Page down)" aria-label="next trial">▶</button>
        <span class="sl-summary" role="status">{{ summary }}</span>
      </header>
      <p v-if="view?.trouble" class="sl-trouble" role="alert">▲ not labelled so: {{ view.trouble }}. The labels on
        disk are shown.</p>
      <p v-for="flag in view?.flags ?? []" :key="flag" class="sl-flag">⚑ {{ flag }}</p>
      <section class="sl-frame" aria-label="frame">
        <canvas ref="picture" role="img" aria-label="frame of the camera in the fingertip"></canvas>
        <input type="range" min="0" :max="last" v-model.number="frame" aria-label="frame" :disabled="!view" />
        <div class="sl-readout" aria-live="polite">{{ readout }}</div>
        <label class="sl-check"><input type="checkbox" v-model="difference" /> change from the untouched frame</label>
      </section>
      <section class="sl-curves" aria-label="forces and margin">
        <canvas ref="curves" role="img" aria-label="forces and safety margin against time"
          @pointerdown="press" @pointermove="drag" @pointerup="release" @pointercancel="release"></canvas>
        <div class="sl-legend">
          <span v-for="name in ['x', 'y', 'z']" :key="name"><i :class="'sl-' + name"></i>{{ name }}</span>
          <span><i class="sl-normal"></i>normal</span><span><i class="sl-tangential"></i>tangential</span>
          <span><i class="sl-interval"></i>margin, ± 1 sigma where valid</span><span><i class="sl-bad"></i>bad</span>
        </div>
      </section>
      <section class="sl-acts" aria-label="repairs">
        <div class="sl-row">
          <button @click="act('reference')" title="this frame is the sensor untouched">Reference here (R)</button>
          <button @click="act('contact')" title="the contact begins at this frame">Contact here (C)</button>
          <button @click="act('slip')" title="the contact slips as a whole from this frame on">Slip here (S)</button>
          <button @click="act('sign')" title="what presses counts the other way">Turn the sign (M)</button>
        </div>
        <div class="sl-row">
          <button @click="act('from')" title="the span begins at this frame">Span from here ([)</button>
          <button @click="act('to')" title="the span ends at this frame">to here (])</button>
          <span class="sl-span">{{ spanWords }}</span>
          <button @click="act('bad')" :disabled="!span" title="its frames are not valid">Bad (B)</button>
          <button @click="act('good')" :disabled="!span" title="no longer bad">Good (G)</button>
          <button @click="act('tare')" :disabled="!span" title="the sensor is untouched in the span: its mean is the tare">
            Tare from it (T)</button>
        </div>
        <div class="sl-row">
          <label v-for="(name, at) in ['x', 'y', 'z']" :key="name">tare {{ name }}, N
            <input type="number" step="0.01" v-model.number="tare[at]" @change="setTare" /></label>
          <label>friction <input type="number" step="0.01" min="0.01" v-model.number="mu" @change="setFriction" />
          </label>
        </div>
        <div class="sl-row">
          <button @click="act('undo')" :disabled="!view?.edits.length">Undo (U)</button>
          <span class="sl-told">{{ lastEdit }}</span>
        </div>
        <ol v-if="view?.edits.length" class="sl-edits" reversed>
          <li v-for="(edit, at) in view.edits.slice().reverse()" :key="at">{{ tell(edit) }}</li>
        </ol>
        <p class="sl-told">Arrow keys move by a frame, with Shift by ten; Shift and drag over the curves choose a span.
          Each edit is kept at once; <code>sliplens label</code> makes the data set's labels follow.</p>
      </section>
    </div>`,
  props: { view: Object, counts: Object },
  data: () => ({ frame: 0, difference: false, span: null, tare: [null, null, null], mu: null, busy: false }),
  computed: {
    last() {
      return (this.view?.time_s.length ?? 1) - 1;
    },
    summary() {
      if (!this.view) return "reading …";
      const { valid, friction, axes, reference, contact_s, slip_s } = this.view;
      const parts = [`${valid.filter(Boolean).length} of ${valid.length} frames valid`];
      if (friction) parts.push(`friction ${friction.mu.toFixed(3)} (${friction.low.toFixed(3)} to ${friction.high.toFixed(3)})`);
      if (contact_s !== null) parts.push(`contact from ${contact_s.toFixed(2)} s`);
      if (slip_s !== null) parts.push(`slip at ${slip_s.toFixed(2)} s`);
      if (axes) parts.push(`${axes.sign > 0 ? "+" : "−"}${axes.normal} presses`);
      parts.push(reference === null ? "reference recorded apart" : `reference: frame ${reference}`);
      return (this.busy ? "labelling … " : "") + parts.join(" · ");
    },
    readout() {
      if (!this.view) return "";
      const { time_s, normal_n, tangential_n, margin, high, valid, words } = this.view, at = this.frame;
      const newtons = (value) => (value === null ? "–" : `${value.toFixed(2)} N`);
      const percent = margin[at] === null ? "–" : `${Math.round(100 * margin[at])} %`;
      const band = valid[at] && high[at] !== null ? ` ± ${Math.round(100 * this.sigma(at))}` : "";
      return `frame ${at} of ${this.last}, ${time_s[at].toFixed(2)} s: normal ${newtons(normal_n[at])}, tangential ` +
        `${newtons(tangential_n[at])}, margin ${percent}${band}, ${words[at]}`;
    },
    spanWords() {
      return this.span ? `frames ${this.span[0]} to ${this.span[1]}` : "no span chosen";
    },
    lastEdit() {
      const edits = this.view?.edits ?? [];
      return edits.length ? `takes back: ${this.tell(edits.at(-1))}` : "no edit yet";
    },
  },
  watch: {
    view(now, before) {
      this.busy = false;
      if (now.trial !== before?.trial) {
        this.span = null;
        this.frame = Math.min(this.frame, this.last);
        this.pictures = new Map();
      }
      this.tare = [...(now.axes?.tare_n ?? [null, null, null])].map((value) => value && Number(value.toFixed(4)));
      this.mu = now.friction && Number(now.friction.mu.toFixed(4));
      this.draw();
    },
    frame: "draw",
    span: "draw",
    difference: "draw",
  },
  mounted() {
    this.pictures = new Map();
    this.onKey = (event) => this.press_key(event);
    window.addEventListener("keydown", this.onKey);
    this.sizes = new ResizeObserver(() => this.draw());
    this.sizes.observe(this.$el);
    this.theme = new MutationObserver(() => this.draw());
    this.theme.observe(document.body, { attributeFilter: ["class"] });
  },
  unmounted() {
    window.removeEventListener("keydown", this.onKey);
    this.sizes.disconnect();
    this.theme.disconnect();
  },
  methods: {
    open(trial) {
      this.busy = true;
      this.$emit("open", trial);
    },
    turn(by) {
      const names = Object.keys(this.counts ?? {}), at = names.indexOf(this.view?.trial) + by;
      if (at in names) this.open(names[at]);
    },
    edit(kind, value) {
      this.busy = true;
      this.$emit("edit", { trial: this.view.trial, kind, value });
    },
    act(name) {
      if (!this.view || this.busy) return;
      const at = this.frame, time = this.forceTime(at);
      const [first, last] = this.span ?? [at, at];
      if (name === "reference") this.edit("reference_frame", at);
      else if (name === "contact") this.edit("contact_s", time);
      else if (name === "slip") this.edit("slip_s", time);
      else if (name === "sign") this.view.axes && this.edit("normal_sign", -this.view.axes.sign);
      else if (name === "from") this.span = [at, Math.max(at, last)];
      else if (name === "to") this.span = [Math.min(first, at), at];
      else if (name === "undo") this.view.edits.length && this.edit("undo", null);
      else if (this.span && name === "tare") this.edit("tare_span", this.span.map((one) => this.forceTime(one)));
      else if (this.span) this.edit(name, [first, last]);
    },
    forceTime(frame) {
      return this.view.time_s[frame] - this.view.shift_s; // on the clock of the forces
    },
    setTare() {
      if (this.tare.every((value) => typeof value === "number")) this.edit("tare", [...this.tare]);
    },
    setFriction() {
      this.edit("mu", typeof this.mu === "number" ? this.mu : null);
    },
    press_key(event) {
      const { key, target } = event;
      if (target.matches("select, input[type=number]") || event.altKey) return;
      const undo = (event.ctrlKey || event.metaKey) && key.toLowerCase() === "z";
      if ((event.ctrlKey || event.metaKey) && !undo) return;
      const step = { ArrowLeft: -1, ArrowRight: 1 }[key];
      if (step) this.frame = clamp(this.frame + step * (event.shiftKey ? 10 : 1), 0, this.last);
      else if (key === "Home") this.frame = 0;
      else if (key === "End") this.frame = this.last;
      else if (key === "PageUp" || key === "PageDown") this.turn(key === "PageUp" ? -1 : 1);
      else if (key === "Escape") this.span = null;
      else if (undo) this.act("undo");
      else if (KEYS[key.toLowerCase()]) event.repeat || this.act(KEYS[key.toLowerCase()]);
      else return;
      event.preventDefault();
    },
    sigma(at) {
      const { margin, low, high } = this.view;
      return Math.max(margin[at] - low[at], high[at] - margin[at]); // one side ends at 0 or 100 %
    },
    tell({ kind, value, by, at }) {
      const when = at.slice(0, 16).replace("T", " ");
      const seconds = kind.endsWith("_s") ? " s" : kind === "tare" ? " N" : "";
      const shown = value === null ? "as found" : [value].flat().map((one) => Number(one.toFixed(3))).join(kind === "tare" ? ", " : " to ");
      return `${WORDS[kind]} ${shown}${value === null ? "" : seconds}, ${by}, ${when}`;
    },
    draw() {
      if (this.scheduled) return;
      this.scheduled = true;
      requestAnimationFrame(() => {
        this.scheduled = false;
        if (!this.view || !this.$refs.curves) return;
        this.drawCurves();
        this.drawPicture();
      });
    },
    async picture(number) {
      const url = `/images/${encodeURIComponent(this.view.trial)}/${number}`;
      if (!this.pictures.has(url)) {
        if (this.pictures.size > 60) this.pictures.delete(this.pictures.keys().next().value);
        this.pictures.set(url, fetch(url).then((answer) => answer.blob()).then(createImageBitmap));
      }
      return this.pictures.get(url);
    },
    async drawPicture() {
      const wanted = this.frame, canvas = this.$refs.picture, untouched = this.view.reference;
      const images = [this.picture(wanted)];
      if (this.difference) images.push(this.picture(untouched ?? 0));
      const [now, rest] = await Promise.all(images).catch(() => []);
      if (!now || wanted !== this.frame) return;
      canvas.width = now.width;
      canvas.height = now.height;
      const context = canvas.getContext("2d");
      context.drawImage(now, 0, 0);
      if (!rest) return;
      context.globalCompositeOperation = "difference";
      context.drawImage(rest, 0, 0);
      context.globalCompositeOperation = "lighter"; // brightened: a touch changes an image by little
      for (let times = 0; times < 2; times++) context.drawImage(canvas, 0, 0);
    },
    place(event) {
      const box = this.$refs.curves.getBoundingClientRect();
      const { left, right, begin, end } = this.scale;
      const time = begin + ((event.clientX - box.left - left) / (right - left)) * (end - begin);
      const apart = this.view.time_s.map((at) => Math.abs(at - time));
      return apart.indexOf(Math.min(...apart));
    },
    press(event) {
      if (!this.view || event.button) return;
      event.target.setPointerCapture(event.pointerId);
      this.held = { at: this.place(event), span: event.shiftKey };
      this.drag(event);
    },
    drag(event) {
      if (!this.held) return;
      this.frame = this.place(event);
      if (this.held.span) this.span = [this.held.at, this.frame].sort((one, other) => one - other);
    },
    release() {
      this.held = null;
    },
    drawCurves() {
      const canvas = this.$refs.curves, ratio = devicePixelRatio, style = getComputedStyle(canvas);
      canvas.width = Math.round(canvas.clientWidth * ratio);
      canvas.height = Math.round(canvas.clientHeight * ratio);
      const context = canvas.getContext("2d"), view = this.view, colour = (name) => style.getPropertyValue(name);
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.font = "11px system-ui, sans-serif";
      const left = 44, right = canvas.clientWidth - 8, height = (canvas.clientHeight - HEAD - 24) / 3;
      const begin = view.time_s[0], end = Math.max(view.time_s.at(-1), begin + 1e-6);
      this.scale = { left, right, begin, end };
      const x = (at) => left + ((at - begin) / (end - begin)) * (right - left);
      const samples = view.samples, axes = samples?.axes_n ?? [];
      const rows = [
        ["as recorded, N", extent(axes), axes.map((values, at) => [samples.time_s, values, AXES[at], 1, []])],
        ["forces, N", extent([view.normal_n, view.tangential_n, [0]]), [
          [view.time_s, view.normal_n, "--sl-ink", 2, []], [view.time_s, view.tangential_n, "--sl-ink", 2, [6, 4]]]],
        ["safety margin, %", [0, 100], []],
      ];
      rows.forEach(([title, [low, high], curves], row) => {
        const top = HEAD + row * height + 18, bottom = HEAD + (row + 1) * height - 4;
        const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
        const half = 0.5 * (x(view.time_s[1] ?? end) - x(begin));
        const band = (first, last, name) => {
          const from = x(view.time_s[first]) - half;
          context.fillStyle = colour(name);
          context.fillRect(from, top, x(view.time_s[last]) + half - from, bottom - top);
        };
        context.save();
        context.beginPath();
        context.rect(left, top - 1, right - left + 2, bottom - top + 2);
        context.clip();
        view.bad_frames.forEach(([first, last]) => band(first, last, "--sl-marked"));
        if (this.span) band(...this.span, "--sl-chosen");
        context.restore();
        context.fillStyle = colour("--sl-faint");
        context.strokeStyle = colour("--sl-line");
        context.lineWidth = 1;
        context.textBaseline = "middle";
        context.textAlign = "right";
        for (const value of row === 2 ? [0, 50, 100] : ticks(low, high)) {
          stroke(context, [[left, y(value)], [right, y(value)]]);
          context.fillText(Number(value.toFixed(2)).toString(), left - 5, y(value));
        }
        context.textAlign = "left";
        context.fillText(title, left, top - 10);
        context.save();
        context.beginPath();
        context.rect(left, top - 1, right - left + 2, bottom - top + 2);
        context.clip();
        for (const [times, values, name, width, dashes] of curves) {
          context.strokeStyle = colour(name);
          context.setLineDash(dashes);
          context.lineWidth = width;
          for (const run of runs(times, values)) stroke(context, run.map(([at, value]) => [x(at), y(value)]));
        }
        context.setLineDash([]);
        if (row === 2) this.drawMargin(context, x, (value) => y(100 * value), colour);
        context.restore();
      });
      const bottom = HEAD + 3 * height - 4;
      const events = [
        [view.contact_s, "contact"], [view.slip_s, "slip"],
        [view.reference === null ? null : view.time_s[view.reference] - view.shift_s, "reference"],
      ].filter(([at]) => at !== null).sort(([one], [other]) => one - other);
      let taken = -Infinity;
      for (const [at, word] of events) {
        const place = x(at + view.shift_s);
        if (place < left - 1 || place > right + 1) continue;
        context.strokeStyle = context.fillStyle = colour("--sl-event");
        context.lineWidth = 1.5;
        context.setLineDash([4, 3]);
        stroke(context, [[place, HEAD], [place, bottom]]);
        context.setLineDash([]);
        const width = context.measureText(word).width;
        const start = clamp(place - width / 2, Math.max(left, taken + 6), right - width);
        context.textAlign = "left";
        context.fillText(word, start, 7);
        taken = start + width;
      }
      context.strokeStyle = colour("--sl-ink");
      context.lineWidth = 1;
      stroke(context, [[x(view.time_s[this.frame]), HEAD], [x(view.time_s[this.frame]), bottom]]);
      context.fillStyle = colour("--sl-faint");
      context.textBaseline = "top";
      for (const at of ticks(begin, end)) {
        context.textAlign = at > end - 0.02 * (end - begin) ? "right" : "center";
        context.fillText(`${Number(at.toFixed(2))} s`, x(at), bottom + 6);
      }
    },
    drawMargin(context, x, y, colour) {
      const { time_s, margin, low, high, valid } = this.view;
      context.fillStyle = colour("--sl-interval");
      for (const run of runs(time_s, high)) {
        const below = run.map(([at, , place]) => [at, low[place]]).reverse();
        context.beginPath();
        [...run, ...below].forEach(([at, value]) => context.lineTo(x(at), y(value)));
        context.fill();
      }
      context.strokeStyle = colour("--sl-ink");
      context.lineWidth = 2;
      for (const run of runs(time_s, margin.map((value, at) => (valid[at] ? value : null)))) {
        stroke(context, run.map(([at, value]) => [x(at), y(value)]));
      }
      context.fillStyle = colour("--sl-faint");
      margin.forEach((value, at) => value !== null && !valid[at] && context.fillRect(x(time_s[at]) - 1, y(value) - 1, 2, 2));
    },
  },
};

const clamp = (value, least, most) => Math.max(least, Math.min(most, value));

function extent(curves) {
  let low = Infinity, high = -Infinity;
  for (const curve of curves) for (const value of curve) if (value !== null) (low = Math.min(low, value)), (high = Math.max(high, value));
  if (!(low <= high)) return [0, 1];
  const room = 0.05 * (high - low) || 0.5;
  return [low - room, high + room];
}

function ticks(low, high) {
  const rough = (high - low) / 4, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= rough);
  const found = [];
  for (let at = Math.ceil(low / step) * step; at <= high + 1e-9; at += step) found.push(at);
  return found;
}

function stroke(context, points) {
  context.beginPath();
  points.forEach(([x, y]) => context.lineTo(x, y));
  context.stroke();
}

// Points in a row that have a value: time, value, place.
function runs(times, values) {
  const found = [];
  let run = null;
  values.forEach((value, at) => {
    if (value === null) return (run = null);
    if (!run) found.push((run = []));
    run.push([times[at], value, at]);
  });
  return found;
}
