//! Channels to which a client is subscribed.

/// Upper limit for the subscriptions of a client: several for each channel.
const MAX_SUBSCRIPTIONS: usize = 64;

/// The subscriptions of a client, which chooses their ids.
#[derive(Debug)]
pub struct Subscriptions {
    num_channels: usize,
    /// Id and channel of each.
    all: Vec<(u32, usize)>,
}

impl Subscriptions {
    /// No subscriptions yet; channels are numbered below `num_channels`.
    pub fn new(num_channels: usize) -> Self {
        Self { num_channels, all: Vec::new() }
    }

    /// Adds a subscription and returns its channel, or the reason for refusing it.
    pub fn add(&mut self, subscription: u32, channel: u32) -> Result<usize, String> {
        let known = usize::try_from(channel).ok().filter(|channel| *channel < self.num_channels);
        let Some(channel) = known else {
            return Err(format!("there is no channel {channel}"));
        };
        if self.all.iter().any(|(id, _)| *id == subscription) {
            return Err(format!("subscription {subscription} already exists"));
        }
        if self.all.len() >= MAX_SUBSCRIPTIONS {
            return Err(format!("a client can have at most {MAX_SUBSCRIPTIONS} subscriptions"));
        }
        self.all.push((subscription, channel));
        Ok(channel)
    }

    /// Removes a subscription if it exists.
    pub fn remove(&mut self, subscription: u32) {
        self.all.retain(|(id, _)| *id != subscription);
    }

    /// Whether a channel has a subscription.
    pub fn has(&self, channel: usize) -> bool {
        self.all.iter().any(|(_, subscribed)| *subscribed == channel)
    }

    /// Ids of the subscriptions to a channel.
    pub fn of(&self, channel: usize) -> impl Iterator<Item = u32> {
        self.all.iter().filter(move |(_, subscribed)| *subscribed == channel).map(|(id, _)| *id)
    }
}
