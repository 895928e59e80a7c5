-- Sequence counts, followed as edoras_tools.sessions.sequence does: one stream may carry several senders that
-- count each for themselves, so it is followed as strands, and a packet belongs to the strand that it continues.
-- What a later packet shows to be no gap, or not late, is taken back: the second pass over a file knows more.

local MODULUS = D.limits.sequence_modulus
local FORWARD = MODULUS / 2  -- a step of half the range or more is a step back
local MOST_STRANDS = 8

local function continued(strands, count)
	for index = 1, #strands do  -- the first, almost always
		if (strands[index].last + 1) % MODULUS == count then return index end
	end
	return nil
end

local function continue(strands, strand)
	strands.moved = true
	if strand.lone then analysis[strand.lone] = nil end
	strand.lone = nil
end

local function begin_strand(strands, count, lone)
	if #strands > 0 then strands.moved = true end
	if lone then analysis[lone] = "reordered" end
	strands[MOST_STRANDS] = nil
	table.insert(strands, 1, {last = count, before = 0, jumped = 0, lone = lone})
end

-- Tell a packet out of what was taken for a gap: it came late, or the jump was another sender's.
local function late(strands, count)
	for _, strand in ipairs(strands) do
		local since = (count - strand.before) % MODULUS
		if since > 0 and since <= strand.jumped then
			analysis[strand.jump] = since > 1 and since - 1 or nil
			strand.jumped = 0
			return true
		end
	end
	return false
end

-- Return the strand to which a count is nearest, going forward, and the step.
local function nearest(strands, count)
	local best, least = nil, MODULUS
	for index, strand in ipairs(strands) do
		local step = (count - strand.last) % MODULUS
		if step < least then best, least = index, step end
	end
	return best, least
end

-- Take the count of the packet in a frame.
local function follow_count(strands, count, frame)
	local index, step = continued(strands, count), nil
	if index then
		continue(strands, strands[index])
	else
		index, step = nearest(strands, count)
		if index and step == 0 then
			if strands.moved then analysis[frame] = "duplicate" end
		elseif late(strands, count) or step >= FORWARD then
			begin_strand(strands, count, #strands > 0 and frame or nil)
			return
		else
			local strand = strands[index]
			strands.moved = true
			strand.before, strand.jumped, strand.jump = strand.last, step - 1, frame
			analysis[frame] = step - 1
		end
	end
	-- The strand that moved last comes first: it is the one that goes on.
	local strand = strands[index]
	strand.last = count
	if index > 1 then table.insert(strands, 1, table.remove(strands, index)) end
end
