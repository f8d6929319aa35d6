// A job's page: plots, live regions while the job is open, and its actions.

import './items.js';
import './lists.js';
import { start, setQuery, listPlots, drawProfiles, redraw, watch } from './figures.js';
import { Problem, address, post, put, refresh, throttle } from './live.js';

const { job, runs } = document.getElementById('job').dataset;
const isOpen = () => document.querySelector('[data-live="chip"]').dataset.open === '1';
const NOT_FOUND = 404;
let stream = null;

// An event only reports that something changed. The page and the figures are fetched to show what.
const renew = throttle(async () => {
  try {
    await refresh();
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (error.document.status === NOT_FOUND) close(); // the job was deleted
    else renew(); // no answer: retry
    return;
  }
  watch();
  if (isOpen()) listen();
  else close();
  await redraw(isOpen() ? ['history', 'convergence'] : undefined);
}, 1000 + Number(runs) / 10); // the page of a sweep reads all of its runs

const ANNOUNCE_MS = 10_000;
let announced = 0;

/** Tell a screen reader how far the job is: its state at once, its progress now and then. */
document.addEventListener('refreshed', () => {
  const place = document.querySelector('[data-announcement]');
  const state = document.querySelector('[data-live="chip"]').textContent.trim();
  const isNew = !place.textContent.startsWith(state);
  if (!isNew && (!isOpen() || performance.now() - announced < ANNOUNCE_MS)) return;
  announced = performance.now();
  const verdict = document.querySelector('.verdict-card h2')?.textContent;
  const progress = document.querySelector('[data-live="head"] .row small')?.textContent;
  place.textContent = [state, isOpen() ? progress : verdict].filter(Boolean).join(': ');
});

function listen() {
  if (!isOpen() || (stream && stream.readyState !== EventSource.CLOSED)) return; // a finished job opens no stream
  const opened = new EventSource(address(`/v1/jobs/${encodeURIComponent(job)}/events`));
  stream = opened;
  // A resumed job's stream repeats its earlier end. The page decides whether the job is over.
  for (const kind of ['message', 'state', 'progress', 'log', 'end']) opened.addEventListener(kind, renew);
  // The browser reconnects by itself, unless it was refused: the job is over, or the server is down.
  opened.addEventListener('error', () => opened.readyState === EventSource.CLOSED && renew());
}

function close() {
  stream?.close();
  stream = null;
}

document.addEventListener('click', async ({ target }) => {
  const button = target.closest('button');
  if (!button) return;
  if (button.dataset.act) await act(button);
  else if ('copy' in button.dataset) await copy(button);
  else if (button.dataset.abscissa) chooseAbscissa(button);
  else if (button.dataset.profile) await drawProfiles(button);
});

async function act(button) {
  const fault = document.getElementById('act-fault');
  fault.textContent = '';
  button.disabled = true;
  try {
    await post(address(`/v1/jobs/${encodeURIComponent(job)}:${button.dataset.act}`));
    await refresh();
    watch();
    listen();
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    fault.textContent = error.message;
    button.disabled = false;
  }
}

document.addEventListener('submit', async (event) => {
  if (!('accept' in event.target.dataset)) return;
  event.preventDefault();
  const { run, name } = event.target.elements;
  const status = event.target.querySelector('[data-accepted]');
  try {
    const reference = await put(address(`/v1/references/${encodeURIComponent(name.value)}`), { run: run.value });
    const before = reference.history[0];
    status.textContent = `The reference ${reference.name} is now ${reference.run}. `
      + (before ? `Before: ${before.run}.` : 'It is the first of this name.');
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    status.textContent = error.message;
  }
});

async function copy(button) {
  const text = button.closest('dialog').querySelector('pre');
  try {
    await navigator.clipboard.writeText(text.textContent);
    button.textContent = 'Copied';
  } catch {
    getSelection().selectAllChildren(text); // without the permission the user copies by hand
  }
}

function chooseAbscissa(button) {
  for (const choice of button.parentElement.children) choice.ariaPressed = String(choice === button);
  setQuery(listPlots().find((p) => p.dataset.figure === 'history'), 'abscissa', button.dataset.abscissa);
}

addEventListener('pagehide', close);
addEventListener('pageshow', (event) => event.persisted && listen());
start();
listen();
