"use strict";
// The page is whole without this; it brings what changes, and sends what buttons want.

const SILENCE = 20000; // ms without a sign of life, which comes every 15 s
const live = document.getElementById("live");
const said = document.getElementById("said");
const away = document.getElementById("away");

async function refresh() {
  const answer = await fetch(live.dataset.live, { headers: { Accept: "text/html" } });
  if (answer.redirected) return location.reload();
  if (answer.ok) live.innerHTML = await answer.text();
}

if (live) {
  const events = new EventSource(live.dataset.events);
  let seen = null, busy = false, again = false;
  let heard = Date.now();
  setInterval(() => { if (Date.now() - heard > SILENCE) away.hidden = false; }, 1000);
  events.addEventListener("alive", () => { heard = Date.now(); away.hidden = true; });
  events.onopen = () => { heard = Date.now(); away.hidden = true; };
  events.onerror = () => { away.hidden = false; };
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
