// Everything that counts is in the folder: this page shows it anew, and may be closed at any time.
"use strict";
const UNKNOWN = "unknown", films = new Map();
let state = null, guide = {}, heard = null, part = "record", shape = "";

async function post(action, body = {}) {
  const headers = {"Content-Type": "application/json"};
  const response = await call(`api/${action}`, {method: "POST", headers, body: JSON.stringify(body)});
  if (!response.ok) throw new Error(await failed(response));
  return response.json();
}

// An action of the user; what the server refuses is said, and what it changed is shown.
async function act(action, body) {
  try {
    const answer = await post(action, body);
    if (["move", "rename", "undo"].includes(action)) {  // A name may stand for another video now.
      films.clear();
      shape = "";
    }
    tell("");
    await refresh().catch(error => tell(error.message));
    return answer;
  } catch (error) {
    tell(error.message);
  }
}

function button(text, name, click) {
  const element = make("button", name, text);
  element.type = "button";
  element.addEventListener("click", click);
  return element;
}

// ---- the folder ----

function objects() {
  const found = new Map();
  const of = id => found.get(id) || found.set(id, {id, videos: [], own: {}, given: []}).get(id);
  for (const video of state.videos) of(video.object_id).videos.push(video.file);
  for (const row of state.ratings) {
    of(row.object_id).given.push(row);
    if (row.rater === rater()) of(row.object_id).own = row;
  }
  return [...found.values()].sort((a, b) => (a.id === UNKNOWN) - (b.id === UNKNOWN));
}

const rater = () => $("rater").value.trim().replace(/\s+/g, " ");
const spoken = id => id.replaceAll("_", " ");

async function refresh() {
  const response = await call(`api/state?rater=${encodeURIComponent(rater())}`);
  if (!response.ok) return tell(await failed(response));
  state = await response.json();
  $("folder").textContent = state.folder;
  $("model").textContent = state.model;
  $("told").textContent = state.told;
  $("undo").disabled = !state.undo;
  drawRecorded();
  drawCards();
  drawSummary();
}

function drawRecorded() {
  const all = objects(), others = all.filter(o => o.id !== UNKNOWN);
  $("known").replaceChildren(...others.map(o => new Option(spoken(o.id))));
  $("again").replaceChildren(new Option("a recorded press", ""), ...state.videos.map(v => new Option(v.file)));
  $("objects").replaceChildren(...all.map(object => {
    const box = make("div", "object"), head = make("div", "row");
    head.append(make("b", "", spoken(object.id)), make("span", "note", `${object.videos.length} recorded`));
    if (object.id !== UNKNOWN) {
      head.append(button("record", "small", () => { $("object").value = spoken(object.id); act("aim", {name: object.id}); }),
        button("rename", "small", () => {
          const name = prompt("Its name, with its article", spoken(object.id));
          if (name) act("rename", {object_id: object.id, name});
        }));
    }
    box.append(head, ...object.videos.map(file => {
      const chip = make("span", "chip", file.replace(/\.\w+$/, "")), other = document.createElement("select");
      other.title = "It is another object";
      other.append(new Option("", ""), ...others.filter(o => o !== object).map(o => new Option(spoken(o.id), o.id)));
      other.addEventListener("change", () => act("move", {file, name: other.value}));
      const remove = button("\u00d7", "", () => act("move", {file, name: ""}));
      remove.title = "Delete it";
      chip.append(other, remove);
      return chip;
    }));
    return box;
  }));
}

// ---- rate ----

async function film(file, frame, difference) {
  const ask = () => call(`api/frames/${encodeURIComponent(file)}`).then(r => r.ok ? r.json() : null).catch(() => null);
  if (!films.has(file)) films.set(file, ask());
  const shown = await films.get(file);
  if (!shown) return films.delete(file);
  let turn = 0;
  const step = () => {
    frame.src = shown.frames[turn % shown.frames.length];
    difference.src = shown.difference[turn++ % shown.frames.length];
    if (frame.isConnected) setTimeout(step, 250);
  };
  step();
}

function slider(object, property) {
  const row = make("div", "slider"), input = document.createElement("input"), said = make("b");
  const level = object.own[property.name];
  const show = value => { said.textContent = value ? property.levels[value] : "not rated yet"; };
  Object.assign(input, {type: "range", min: 0, max: property.levels.length - 1, value: level || 0});
  input.setAttribute("aria-label", `${spoken(property.name)} of ${spoken(object.id)}`);
  input.classList.toggle("unset", !level);
  show(level);
  // A click on an unset slider's own place changes nothing, and counts all the same.
  const rate = async () => {
    if (!rater()) return tell("Write your name first: raters do not see each other's ratings.");
    if (object.own[property.name] === input.value) return;
    const before = object.own;
    object.own = {...before, [property.name]: input.value};
    input.classList.remove("unset");
    show(input.value);
    const given = {rater: rater(), object_id: object.id, property: property.name, level: Number(input.value)};
    if (await act("rate", given) !== undefined) return;
    if (object.own[property.name] !== String(given.level)) return;  // It was moved again meanwhile.
    const old = before[property.name];  // It is not written down, so it is not shown, and the next click sends it again.
    object.own = {...object.own, [property.name]: old};
    input.value = old || 0;
    input.classList.toggle("unset", !old);
    show(old);
  };
  input.addEventListener("input", () => show(input.value));
  for (const kind of ["change", "click"]) input.addEventListener(kind, rate);
  row.append(make("span", "", spoken(property.name)), input, said);
  return row;
}

function drawCards() {
  const all = objects().filter(o => o.id !== UNKNOWN), whole = o => state.properties.every(p => o.own[p.name]);
  $("progress").textContent = rater() ? `${all.filter(whole).length} of ${all.length} objects rated` : "";
  // Films go on while ratings change: cards are built anew only where objects, videos or the rater are others.
  const now = JSON.stringify([all.map(o => [o.id, o.videos]), rater()]);
  if (now !== shape) {
    shape = now;
    $("cards").replaceChildren(...all.map(object => {
      const card = make("article", "card"), row = make("div", "films"), sliders = make("div");
      card.dataset.object = object.id;
      row.append(...object.videos.map(file => {
        const figure = make("figure"), frame = make("img"), difference = make("img");
        frame.alt = file;
        difference.alt = `${file}, difference to the untouched gel`;
        figure.append(frame, difference, make("figcaption", "", file.replace(/\.\w+$/, "")));
        requestAnimationFrame(() => film(file, frame, difference));
        return figure;
      }));
      sliders.append(...state.properties.map(p => slider(object, p)));
      card.append(make("h2", "", spoken(object.id)), row, sliders);
      return card;
    }));
  }
  for (const object of all) document.querySelector(`[data-object="${object.id}"]`).classList.toggle("done", whole(object));
  $("guide").replaceChildren(...state.properties.flatMap(p => {
    const told = guide[p.name] || {levels: {}}, table = make("table");
    table.append(...p.levels.map((level, n) => {
      const line = make("tr");
      line.append(make("th", "", `${n} ${level}`), make("td", "", told.levels[level] || p.phrases[n].join("; ")));
      return line;
    }));
    const how = told.what ? [make("p", "note", `${told.what}; judged ${told.how}`)] : [];
    return [make("h3", "", spoken(p.name)), ...how, table];
  }));
}

// Classes that no object has, then pairs of classes that no object has both of; an object's class is its mean rating.
function lacking(all) {
  const labels = all.map(o => state.properties.map(p => {
    const given = o.given.map(row => row[p.name]).filter(Boolean).map(Number);
    return given.length ? Math.floor(given.reduce((a, b) => a + b) / given.length + 0.5) : null;
  }));
  const every = state.properties.flatMap((p, place) => p.levels.map((word, level) => ({place, level, word})));
  const has = (own, one) => own[one.place] === one.level, met = one => labels.some(own => has(own, one));
  const pairs = every.filter(met).flatMap(a => every.filter(met).filter(b => a.place < b.place).map(b => [a, b]));
  const apart = pairs.filter(([a, b]) => !labels.some(own => has(own, a) && has(own, b)));
  return [...every.filter(one => !met(one)).map(one => one.word), ...apart.map(([a, b]) => `${a.word} and ${b.word}`)];
}

function drawSummary() {
  const all = objects().filter(o => o.id !== UNKNOWN);
  if (!state.agreement) {
    const wait = "Raters are blind to each other: this is shown once you have rated every object.";
    $("summary").replaceChildren(make("p", "note", wait));
    return $("next").replaceChildren(make("li", "note", wait));
  }
  const table = make("table"), missing = lacking(all);
  table.append(...Object.entries(state.agreement).map(([name, icc]) => {
    const line = make("tr"), said = icc ? `${icc[0].toFixed(2)} (${icc[1].toFixed(2)} to ${icc[2].toFixed(2)})`
      : "needs two raters of the same objects, which differ";
    line.append(make("th", "", spoken(name)), make("td", "", said));
    return line;
  }));
  const list = make("ul");
  list.append(...missing.slice(0, 8).map(words => make("li", "", `no ${words} object yet`)));
  const raters = [...new Set(state.ratings.map(row => row.rater))].join(", ") || "nobody yet";
  $("summary").replaceChildren(make("p", "note", `Rated by ${raters}. ICC(3,k) of those who rated most, with 95 % interval:`), table, list);
  const spread = object => state.properties.reduce((sum, p) => {
    const given = object.given.map(row => row[p.name]).filter(Boolean).map(Number);
    return sum + (given.length ? Math.max(...given) - Math.min(...given) : 0);
  }, 0);
  const worst = all.filter(o => spread(o) > 0).sort((a, b) => spread(b) - spread(a)).slice(0, 2);
  $("next").replaceChildren(...worst.map(o => make("li", "", `${spoken(o.id)} again: raters disagree on it`)),
    ...missing.slice(0, 3).map(words => make("li", "", `a ${words} object: there is none yet`)));
}

// ---- the sensor ----

async function listen() {
  try {
    const response = await call("api/live"), live = response.ok ? await response.json() : null;
    if (response.status === 401) {
      $("gone").textContent = "The studio was started anew; open the address that it shows now.";
      return;
    }
    draw_sensor(live);
    if (heard !== null && live.said > heard) {
      await refresh();
      const fresh = live.events.slice(heard - live.said).filter(e => e.file);
      if (part === "adapt") for (const event of fresh) await feel(event.file);
    }
    heard = live.said;
  } catch {
    $("gone").textContent = "The studio does not answer; start it again: all that was recorded and rated is in the folder.";
  }
  setTimeout(listen, 120);
}

function draw_sensor(live) {
  if (live.picture) {
    $("picture").src = live.picture;
    $("difference").src = live.difference;
  }
  const last = live.curve.at(-1) || 0, top = Math.max(4, ...live.curve);
  $("curve").classList.toggle("pressed", Boolean(live.pressed));
  $("curve").firstElementChild.setAttribute("y1", 110 - 105 / top);
  $("curve").firstElementChild.setAttribute("y2", 110 - 105 / top);
  $("curve").lastElementChild.setAttribute("points", live.curve.map((s, i) => `${4 * i},${110 - 105 * s / top}`).join(" "));
  $("strength").textContent = live.pressed ? `pressed, ${last.toFixed(1)} times what a press begins at` : "untouched";
  $("gone").textContent = live.gone;
  $("rate-of").textContent = live.rate ? `${live.rate.toFixed(1)} pictures a second` : "";
  $("notes").replaceChildren(...live.notes.map(note => make("li", "", note)));
  $("events").replaceChildren(...live.events.slice(-5).reverse().map(e => make("li", "", e.text)));
  $("lately").textContent = [live.gone, live.events.at(-1)?.text].filter(Boolean).join("; ");
  $("target").textContent = live.target ? `Press it now: each press is recorded as ${live.target}_NUMBER.mp4`
    : "Nothing is recorded: name the object.";
  $("busy").textContent = live.busy;
  if (document.activeElement !== $("camera")) $("camera").value = live.camera;
}

// ---- adapt and ask ----

async function feel(file) {
  if (touches.length >= MOST) touches.shift();
  fresh = fresh.filter(id => touches.some(touch => touch.id === id));
  await show(`api/presses/${encodeURIComponent(file)}`, null, file);
  const touch = touches.at(-1);
  if (!touch || touch.name !== file) return;
  touch.sentence = await post("describe", {touch: touch.id}).catch(error => error.message);
  draw();
}

async function compare() {
  if (touches.length < 2) return tell("Press two objects first, or choose recorded presses.");
  const [a, b] = touches.slice(-2);
  tell("Compares ...", true);
  const found = await act("compare", {a: a.id, b: b.id});
  if (!found) return;
  const table = make("table"), spoke = found.some(one => one.answer);  // Else the language model is not asked.
  table.append(...found.map(one => {
    const line = make("tr"), values = one.expected.map(value => value.toFixed(1)).join(" and ");
    line.append(make("th", "", spoken(one.property)), make("td", "", values));
    if (spoke) line.append(make("td", "", one.answer.split("Conclusion:").at(-1)));
    return line;
  }));
  $("compared").replaceChildren(make("h2", "", `${a.name} and ${b.name}`),
    make("p", "note", `Expected classes by the property heads${spoke ? ", and what the language model concludes" : ""}`), table);
}

function open(name) {
  if (name === "adapt" || part === "adapt") act("aim", {name: name === "adapt" ? UNKNOWN : ""});
  part = name;
  for (const tab of document.querySelectorAll(".tab")) {
    tab.classList.toggle("open", tab.dataset.part === name);
    $(tab.dataset.part).hidden = tab.dataset.part !== name;
  }
  refresh();
}

for (const tab of document.querySelectorAll(".tab")) tab.addEventListener("click", () => open(tab.dataset.part));
for (const [id, submit] of Object.entries({
  connect: () => act("connect", {camera: $("camera").value}),
  aim: () => act("aim", {name: $("object").value}),
})) $(id).addEventListener("submit", event => { event.preventDefault(); submit(); });
document.querySelector("#rate form").addEventListener("submit", event => event.preventDefault());
$("pause").addEventListener("click", () => act("aim", {name: ""}));
$("undo").addEventListener("click", () => act("undo"));
$("rater").addEventListener("change", refresh);
$("both").addEventListener("click", compare);
$("again").addEventListener("change", () => { const file = $("again").value; if (file) feel(file); $("again").value = ""; });
$("fit").addEventListener("click", async () => {
  $("fit").disabled = true;
  await act("adapt");
  $("fit").disabled = false;
});
fetch("raters.json").then(r => r.json()).then(found => { guide = found; open("record"); listen(); });
