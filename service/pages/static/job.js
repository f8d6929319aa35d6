// A job's page: plots, live regions while the job is open, and its actions.

import { begin, choose, plots, profile, redraw, watch } from './figures.js';
import { Problem, element, post, put, refresh, throttled } from './live.js';

const { job, runs } = document.getElementById('job').dataset;
const isOpen = () => document.querySelector('[data-live="chip"]').dataset.open === '1';
const NOT_FOUND = 404;
let stream = null;

// An event only says that something is new; the page and the figures themselves say what.
const renew = throttled(async () => {
  try {
    await refresh();
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (error.document.status === NOT_FOUND) close(); // it was deleted
    else renew(); // the server is away: asked again
    return;
  }
  watch();
  if (isOpen()) listen();
  else close();
  await redraw(isOpen() ? ['history', 'convergence'] : undefined);
}, 1000 + Number(runs) / 10); // the database looks at all runs of a sweep for its page

function listen() {
  if (!isOpen() || (stream && stream.readyState !== EventSource.CLOSED)) return; // a finished job opens no stream
  const opened = new EventSource(`/v1/jobs/${encodeURIComponent(job)}/events`);
  stream = opened;
  // Of a resumed job the stream tells its earlier end, too: whether it is over, the page says.
  for (const kind of ['message', 'state', 'progress', 'log', 'end']) opened.addEventListener(kind, renew);
  // It comes again by itself, unless it was refused: the job is over, or the server is away.
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
  else if (button.dataset.dialog) document.getElementById(button.dataset.dialog).showModal();
  else if ('close' in button.dataset) button.closest('dialog').close();
  else if ('copy' in button.dataset) await copy(button);
  else if (button.dataset.abscissa) abscissa(button);
  else if (button.dataset.profile) await profile(button);
});

async function act(button) {
  const fault = document.getElementById('act-fault');
  fault.textContent = '';
  button.disabled = true;
  try {
    await post(`/v1/jobs/${encodeURIComponent(job)}:${button.dataset.act}`);
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
  const told = event.target.querySelector('[data-accepted]');
  try {
    const found = await put(`/v1/references/${encodeURIComponent(name.value)}`, { run: run.value });
    const before = found.history[0];
    told.textContent = `The reference ${found.name} is now ${found.run}. `
      + (before ? `Before: ${before.run}.` : 'It is the first of this name.');
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    told.textContent = error.message;
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

function abscissa(button) {
  for (const one of button.parentElement.children) one.ariaPressed = String(one === button);
  choose(plots().find((p) => p.dataset.figure === 'history'), 'abscissa', button.dataset.abscissa);
}

// Which records there are, the figure itself tells.
document.addEventListener('drawn', ({ target, detail }) => {
  const names = detail.meta?.experiments ?? [];
  const choice = document.querySelector(`[data-experiment="${target.dataset.figure}"]`);
  if (!choice || names.length < 2 || choice.options.length) return;
  names.forEach((name, place) => choice.append(new Option(`${place + 1} · ${name}`, place)));
  choice.parentElement.hidden = false;
});
document.addEventListener('change', ({ target }) => {
  const name = target.dataset.experiment;
  if (name) choose(plots().find((p) => p.dataset.figure === name), 'experiment', target.value);
});

addEventListener('pagehide', close);
addEventListener('pageshow', (event) => event.persisted && listen());
begin();
listen();
