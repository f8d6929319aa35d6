// The list of jobs: refreshed every few seconds while a job is open and the page is visible.

import { refresh } from './live.js';

const EVERY_MS = 2000;
const list = document.querySelector('[data-live="jobs"]');

async function poll() {
  if (!document.hidden && list.dataset.open === '1') await refresh().catch(() => null);
  setTimeout(poll, EVERY_MS);
}

setTimeout(poll, EVERY_MS);
