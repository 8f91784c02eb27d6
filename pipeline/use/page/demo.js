// The page keeps the conversation; the server keeps the videos, and remembers nothing of what was said.
"use strict";
const $ = id => document.getElementById(id);
const MOST = 3;
let touches = [];  // shown on the page
let fresh = [];    // ids of those that no question was about yet
let turns = [];    // of the conversation: {question, touches, answer}
let talk = new AbortController();  // a new conversation breaks off the answer of the one before

// The studio's address ends with a token; the demo has none.
function call(address, options = {}) {
  return fetch(address, {...options, headers: {...options.headers, Authorization: `Bearer ${location.hash.slice(1)}`}});
}

// Text is only ever set as text: a file's name or an answer never becomes markup.
function make(tag, name, text) {
  const element = document.createElement(tag);
  if (name) element.className = name;
  if (text !== undefined) element.textContent = text;
  return element;
}

function tell(text, busy = false) {
  $("message").textContent = text;
  $("message").classList.toggle("busy", busy);
}

async function failed(response) {
  const body = await response.json().catch(() => ({}));
  const detail = Array.isArray(body.detail) ? body.detail.map(found => found.msg).join("; ") : body.detail;
  return body.error || detail || `The server answered with status ${response.status}; see its terminal.`;
}

function strip(title, pictures, captions) {
  const row = make("div", "strip");
  pictures.forEach((source, i) => {
    const figure = make("figure");
    row.append(figure);
    if (!source) return;  // an empty place keeps the rows in columns
    const image = make("img");
    image.src = source;
    image.alt = `${title}, ${captions[i]}`;
    figure.append(image, make("figcaption", "", captions[i]));
  });
  return [make("p", "note", title), row];
}

function bars(touch) {
  const grid = make("div", "bars");
  grid.append(make("p", "note", `${touch.calibrated ? "Probabilities" :
    "Scores, not calibrated on real videos,"} of each property alone; bold: the classes that go best together`));
  for (const [property, classes] of Object.entries(touch.probabilities)) {
    grid.append(make("h3", "", property));
    for (const [level, share] of Object.entries(classes)) {
      const bar = make("div", "bar"), filled = make("i");
      filled.style.width = `${100 * share}%`;
      bar.append(filled);
      grid.append(make("span", touch.levels[property] === level ? "chosen" : "", level), bar,
        make("span", "number", touch.calibrated ? `${Math.round(100 * share)} %` : share.toFixed(2)));
    }
  }
  return grid;
}

function draw() {
  $("touches").replaceChildren(...touches.map((touch, place) => {
    const box = make("article", "touch"), head = make("header"), remove = make("button", "remove", "Remove");
    remove.addEventListener("click", () => {
      touches = touches.filter(t => t !== touch);
      fresh = fresh.filter(id => id !== touch.id);
      draw();
    });
    head.append(make("h2", "", `${place + 1}. ${touch.name}`), remove);
    const names = ["untouched", ...touch.numbers.map(n => `frame ${n}`)];
    box.append(head, ...(touch.sentence ? [make("p", "sentence", touch.sentence)] : []),
      ...touch.notes.map(note => make("p", "note", note)),
      ...strip("What the model is given, behind the untouched sensor", [touch.reference, ...touch.frames],
        names),
      ...strip("Difference to the untouched sensor (grey: none)", [null, ...touch.difference], names),
      ...strip(`Where it touches: ${Math.round(100 * touch.contact)} % of the picture`, [null, ...touch.touched], names),
      bars(touch));
    return box;
  }));
  $("file").disabled = $("scene").disabled = touches.length >= MOST;
}

async function show(address, body, name) {
  if (touches.length >= MOST) return tell(`No more than ${MOST} touches at a time; remove one.`);
  tell(`Feeling ${name} ...`, true);
  try {
    const response = await call(address, {method: "PUT", body});
    if (!response.ok) return tell(await failed(response));
    const touch = await response.json();
    touches.push(touch);
    fresh.push(touch.id);
    draw();
    tell("");
  } catch {
    tell("The server does not answer; is it still running?");
  }
}

async function take(files) {
  for (const file of files) {
    await show(`api/touches/${encodeURIComponent(file.name)}`, file, file.name);
    if ($("message").textContent) return;
  }
}

function say(who, text) {
  const bubble = make("div", `said ${who}`, text);
  $("chat").append(bubble);
  return bubble;
}

async function ask(event) {
  event.preventDefault();
  let question = $("question").value.trim();
  if ($("send").disabled) return;
  if (!touches.length && !turns.length) return tell("Choose a video or a synthetic scene first.");
  if (!question) question = $("question").placeholder;
  if (!question.includes("{tactile}") && fresh.length) question = `${"{tactile} ".repeat(fresh.length)}${question}`;
  const places = question.split("{tactile}").length - 1;
  // A question is about the new touches first, else about those on the page.
  const about = (fresh.length === places ? fresh : touches.map(t => t.id)).slice(0, Math.max(places, fresh.length));
  $("send").disabled = true;
  tell("");
  const {signal} = talk, asked = say("person", question), said = say("model", "...");
  try {
    const response = await call("api/ask", {
      method: "POST", headers: {"Content-Type": "application/json"}, signal,
      body: JSON.stringify({question, touches: about, history: turns}),
    });
    if (!response.ok) throw new Error(await failed(response));
    let answer = "";
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    for (let piece = await reader.read(); !piece.done; piece = await reader.read()) {
      answer += piece.value;
      said.textContent = answer.split("\x1e")[0];
    }
    signal.throwIfAborted();
    const [spoken, heads] = answer.split("\x1e");
    if (heads) said.after(make("p", "note heads", heads));
    turns.push({question, touches: about, answer: spoken});
    fresh = fresh.filter(id => !about.includes(id));
    $("question").value = "";
  } catch (error) {
    asked.remove();
    said.remove();
    if (signal.aborted) $("question").value = "";
    else tell(error.message);
  }
  $("send").disabled = false;
}

async function begin() {
  const about = await (await call("api/about")).json();
  $("model").textContent ||= about.model;
  $("question").placeholder = about.example;
  if (about.scenes.length) tell("Begin with a video of yours, or pick a synthetic scene; then press Ask.", true);
  for (const [id, name] of about.scenes) $("scene").append(new Option(name, id));
}

$("file").addEventListener("change", async () => { await take($("file").files); $("file").value = ""; });
$("scene").addEventListener("change", async () => {
  const {value, label} = $("scene").selectedOptions[0];
  if (value) await show(`api/scenes/${encodeURIComponent(value)}`, null, `${label}, which is rendered first,`);
  $("scene").value = "";
});
$("drop").addEventListener("dragover", event => { event.preventDefault(); $("drop").classList.add("over"); });
$("drop").addEventListener("dragleave", () => $("drop").classList.remove("over"));
$("drop").addEventListener("drop", event => {
  event.preventDefault();
  $("drop").classList.remove("over");
  take(event.dataTransfer.files);
});
$("ask").addEventListener("submit", ask);
$("question").addEventListener("keydown", event => {
  if (event.key === "Enter" && !event.shiftKey) ask(event);
});
$("reset").addEventListener("click", () => {
  talk.abort();
  talk = new AbortController();
  turns = [];
  fresh = touches.map(t => t.id);
  $("chat").replaceChildren();
  tell("");
});
begin();
