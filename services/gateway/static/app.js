"use strict";
// The page is whole without this; it brings what changes, and sends what buttons want.

const SILENCE = 20000; // ms without a sign of life, which comes every 15 s
const RETRY = 2000; // ms until a stream that the browser gave up is asked for again
const live = document.getElementById("live");
const said = document.getElementById("said");
const away = document.getElementById("away");

// Two nodes of which one can become the other: never a button that sends something else.
function alike(node, wanted) {
  if (node.nodeType !== Node.ELEMENT_NODE) return node.nodeType === wanted.nodeType;
  if (node.nodeName !== wanted.nodeName) return false;
  return ["class", "data-post", "data-body"].every((name) => node.getAttribute(name) === wanted.getAttribute(name));
}

function become(node, wanted) {
  if (node.isEqualNode(wanted)) return;
  if (node.nodeType !== Node.ELEMENT_NODE) { node.data = wanted.data; return; }
  for (const name of node.getAttributeNames()) if (!wanted.hasAttribute(name)) node.removeAttribute(name);
  for (const { name, value } of wanted.attributes) node.setAttribute(name, value);
  fill(node, wanted);
}

// Nodes that stay are kept: a button that is replaced between press and release is never clicked,
// and the focus and how far a table is scrolled would be lost at each change.
function fill(node, wanted) {
  let at = node.firstChild;
  for (const child of [...wanted.childNodes]) {
    let kept = at;
    while (kept && !alike(kept, child)) kept = kept.nextSibling;
    if (!kept) { node.insertBefore(child, at); continue; }
    while (at !== kept) { const gone = at; at = at.nextSibling; gone.remove(); }
    become(kept, child);
    at = kept.nextSibling;
  }
  while (at) { const gone = at; at = at.nextSibling; gone.remove(); }
}

async function refresh() {
  const answer = await fetch(live.dataset.live, { headers: { Accept: "text/html" } });
  if (answer.redirected) return location.reload();
  if (!answer.ok) return;
  const wanted = document.createElement("template");
  wanted.innerHTML = await answer.text();
  fill(live, wanted.content);
}

let heard = Date.now();

function listen() {
  const events = new EventSource(live.dataset.events);
  let seen = null, busy = false, again = false;
  events.addEventListener("alive", () => { heard = Date.now(); away.hidden = true; });
  events.onopen = () => { seen = null; heard = Date.now(); away.hidden = true; }; // another gateway counts anew
  events.onerror = () => {
    away.hidden = false;
    if (events.readyState === EventSource.CLOSED) setTimeout(relisten, RETRY); // as after a proxy's 502
  };
  events.onmessage = async (event) => {
    heard = Date.now();
    away.hidden = true;
    if (event.data === seen) return;
    seen = event.data;
    if (busy) { again = true; return; }
    busy = true;
    try { do { again = false; await refresh(); } while (again); } catch { away.hidden = false; } finally { busy = false; }
  };
}

async function relisten() {
  await refresh().catch(() => {}); // leads to the way in, where the token has ended
  listen();
}

if (live) {
  setInterval(() => { if (Date.now() - heard > SILENCE) away.hidden = false; }, 1000);
  listen();
}

const UNSURE = "No answer from the gateway: it may or may not have been done. Look at the robot, and at what the page says of it.";

function key() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (b) => b.toString(16).padStart(2, "0")).join("");
}

document.addEventListener("click", async (event) => {
  const button = event.target.closest("button[data-post]");
  if (!button) return;
  if (button.dataset.ask && !confirm(button.dataset.ask)) return;
  button.disabled = true;
  said.hidden = true;
  try {
    const headers = { "Idempotency-Key": key() };
    if (button.dataset.body) headers["Content-Type"] = "application/json";
    const answer = await fetch(button.dataset.post, { method: "POST", headers, body: button.dataset.body || "" });
    if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).detail || UNSURE);
    if (live) await refresh();
  } catch (error) {
    said.textContent = error instanceof TypeError ? UNSURE : error.message;
    said.hidden = false;
  } finally {
    button.disabled = false;
  }
});
