// A dataset's page: its signals.

import { start } from './figures.js';

start();
